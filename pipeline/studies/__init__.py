"""Studies what the core estimates, and holds what all studies share; begin with `toolkit.localization`.

The studies of families are in `fuselog.pipeline.families`.
"""
