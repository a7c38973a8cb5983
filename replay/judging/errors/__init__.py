"""Errors of estimates against the truth at their stamps; begin with `evaluation`."""
