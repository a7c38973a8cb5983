"""Estimates against the truth: errors, consistency, sets, tracks, verification; begin with `judge`."""
