"""Studies samples and the systems of the S2KF paper; begin with `reactor`."""
