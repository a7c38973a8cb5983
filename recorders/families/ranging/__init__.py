"""Simulator of ranges from radio tags to anchors; begin with `simulator`."""
