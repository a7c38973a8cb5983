"""Runs several filters side by side: interacting multiple models, and Gaussian sums.

Begin with `imm`.
"""
