"""Models of the systems in the S2KF paper; begin with `reactor`.

The samplings, and the filter that uses them, are in `fuselog.replay.inference`.
"""
