"""Evaluation of tracks against the targets that they should follow; begin with `tracks`."""
