"""Comparison of tracks with the targets that they should follow; begin with `tracks`."""
