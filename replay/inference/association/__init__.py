"""Tracks of many targets from unordered detections; begin with `tracking`."""
