"""Studies guaranteed sets; begin with `set_membership`."""
