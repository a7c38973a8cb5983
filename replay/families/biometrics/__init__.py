"""Fuses biometric scores, and judges verification; begin with `estimators`."""
