"""Tracks many targets from unordered detections; begin with `tracking`."""
