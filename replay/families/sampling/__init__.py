"""Models the systems of the S2KF paper; begin with `reactor`."""
