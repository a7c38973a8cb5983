"""Kalman filters: prediction, update, and methods that consist of these two steps.

Begin with `reference`, an extended Kalman filter in two short functions. `predict` and `update` are the
compiled equivalents, in the form that `steps` defines.
"""
