"""Guaranteed sets of positions from bounded errors; begin with `set_membership`."""
