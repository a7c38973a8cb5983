"""Locates tags by their ranges to anchors; begin with `model`."""
