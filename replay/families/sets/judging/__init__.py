"""Judges sets of points and regions by the truth; begin with `distances`."""
