"""Judges tracks by the targets that they should follow; begin with `tracks`."""
