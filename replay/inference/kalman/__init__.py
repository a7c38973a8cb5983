"""Predicts and updates recursive Gaussian filters, and lists the methods made of these steps.

Begin with `steps`; the Kalman update itself is in `update`.
"""
