"""Localization of shooters and sound sources from arrival times; begin with `localization`.

That module belongs to the estimator `shooter`, which locates single shots. `shot_sequence` and
`sound_source` are models, which any method can estimate.
"""
