"""Fusion of biometric scores; begin with `biometrics`."""
