"""Simulator of relative bearings with bounded errors; begin with `simulator`.

`fuselog.pipeline.families.sets.error_bounds` derives bounds from real recordings.
"""
