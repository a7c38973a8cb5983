"""Tracks against the targets that they should follow; begin with `tracks`."""
