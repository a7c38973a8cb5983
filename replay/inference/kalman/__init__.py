"""Prediction and update of recursive Gaussian filters, and the methods made of them.

Begin with `steps`.
"""
