"""Computes with small matrices in place, and with states on their manifold.

Begin with `gaussian`.
"""
