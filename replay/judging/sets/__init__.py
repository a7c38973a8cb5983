"""Judges sets of points and regions against the truth; begin with `distances`."""
