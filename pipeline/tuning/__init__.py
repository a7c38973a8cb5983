"""Estimation of the parameters with which an estimator explains logs best, and of their accuracy.

Begin with `tuning`.
"""
