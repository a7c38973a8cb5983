"""Models the systems of the S2KF paper; begin with `reactor`.

The samplings themselves, and the filter that takes them, are in `fuselog.replay.inference`.
"""
