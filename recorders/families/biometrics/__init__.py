"""Simulator and importer of scores of biometric matchers; begin with `simulator`."""
