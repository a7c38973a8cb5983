"""Localization of targets from lines of sight, with estimation of sensor biases.

Begin with `localization`.
"""
