"""Tracks many targets: scans, detections, reports, and the PHD filter.

Begin with `tracker`.
"""
