"""Computes the regions that bounded errors leave: exact sets, pseudo-ellipsoids, sets that move.

Begin with `feasible_sets`.
"""
