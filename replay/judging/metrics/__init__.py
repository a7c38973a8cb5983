"""Metrics, which compute numbers from errors, innovations and other outputs; begin with `measuring`."""
