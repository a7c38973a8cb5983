"""Studies of the core's estimators, and functions for all studies; begin with `toolkit.localization`.

The studies of families are in `fuselog.pipeline.families`.
"""
