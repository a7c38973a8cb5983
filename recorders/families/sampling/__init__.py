"""Simulates the systems of the S2KF paper: a batch reactor and an extended target.

Begin with `reactor`. The samplings are in `fuselog.replay.inference.sampling`.
"""
