"""Comparison of two or more estimators over the same runs, with a verdict on every metric.

Begin with `comparing`.
"""
