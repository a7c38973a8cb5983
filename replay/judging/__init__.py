"""Judges estimates by truth: errors, consistency, sets, tracks, verification; begin with `judge`."""
