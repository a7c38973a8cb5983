"""Simulators of the systems in the S2KF paper: a batch reactor and an extended target.

Begin with `reactor`. The sampling schemes are in `fuselog.replay.inference.sampling`.
"""
