"""Localization of shooters and sound sources from arrival times; begin with `localization`.

`localization` is used by the estimator `shooter`, which locates single shots. `shot_sequence` and
`sound_source` define models whose states any method can estimate.
"""
