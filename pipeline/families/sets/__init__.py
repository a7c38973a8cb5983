"""Studies of guaranteed sets; begin with `set_membership`."""
