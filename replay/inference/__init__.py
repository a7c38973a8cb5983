"""Models written once, and the methods that estimate with them."""
