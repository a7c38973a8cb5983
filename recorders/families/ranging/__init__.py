"""Simulates ranges of radio tags to anchors; begin with `simulator`."""
