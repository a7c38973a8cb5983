"""Fuses biometric scores; begin with `biometrics`."""
