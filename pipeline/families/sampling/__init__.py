"""Studies of sampling filters and of the systems of the S2KF paper; begin with `reactor`.

The samplings themselves are in `fuselog.replay.inference.sampling`.
"""
