"""Simulates relative bearings with bounded errors; begin with `simulator`.

How bounds follow from real recordings is in `fuselog.pipeline.families.sets.error_bounds`.
"""
