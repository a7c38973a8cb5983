"""Locates shooters and sources of sound by arrival times; begin with `localization`.

That is the estimator `shooter`, of single shots. `shot_sequence` and `sound_source` are models of their
own, for any method.
"""
