"""Holds estimators, one package per family, and models that any method estimates; begin with `models`.

The methods themselves, such as `ekf`, are in `fuselog.replay.inference`.
"""
