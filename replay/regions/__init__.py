"""Regions of the plane that bounded errors leave: exact sets, pseudo-ellipsoids, and sets that move.

Begin with `feasible_sets`.
"""
