"""Models for every recursive method, one file a system; begin with `landmarks`."""
