"""Simulates relative bearings with bounded errors; begin with `simulator`."""
