"""Compares two estimators or more over the same runs, with a verdict on every metric.

Begin with `comparing`.
"""
