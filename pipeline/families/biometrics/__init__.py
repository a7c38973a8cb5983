"""Studies of biometric scores: fusion and sequential verification; begin with `study`."""
