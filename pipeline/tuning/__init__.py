"""Finds which parameters of an estimator explain logs best, and how well the logs tell them.

Begin with `tuning`.
"""
