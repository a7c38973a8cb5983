"""Records scores of biometric matchers; begin with `simulator`."""
