"""Metrics, which compute values from errors, innovations and other outputs; begin with `measuring`."""
