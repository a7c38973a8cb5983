"""Metrics: the numbers computed from errors, innovations and other outputs; begin with `measuring`."""
