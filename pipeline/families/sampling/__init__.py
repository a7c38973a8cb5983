"""Studies of sampling and of the systems in the S2KF paper; begin with `reactor`.

The sampling schemes are in `fuselog.replay.inference.sampling`.
"""
