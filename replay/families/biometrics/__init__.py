"""Fusion of biometric scores, and evaluation of verification; begin with `estimators`."""
