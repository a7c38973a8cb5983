"""Localization of tags from their ranges to anchors; begin with `model`."""
