"""Comparison of point sets and regions with the truth; begin with `distances`."""
