"""Studies samples and the systems of the S2KF paper; begin with `reactor`.

The samplings themselves are in `fuselog.replay.inference.sampling`.
"""
