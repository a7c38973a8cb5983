"""Predicts and updates recursive Gaussian filters, and lists the methods made of these steps.

Begin with `reference`, an extended Kalman filter in two short functions. `predict` and `update` compute
the same compiled, as `steps` defines them.
"""
