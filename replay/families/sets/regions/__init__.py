"""Regions from bounded errors: exact sets, pseudo-ellipsoids, sets that move.

Begin with `feasible_sets`.
"""
