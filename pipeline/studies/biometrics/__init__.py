"""Studies of biometric scores: fusion, and verification in sequence; begin with `biometrics`."""
