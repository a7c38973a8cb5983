"""Simulates vehicles that sensors of other vehicles see; begin with `simulator`."""
