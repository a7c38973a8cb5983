"""Regions from bounded errors: exact sets, pseudo-ellipsoids and moving sets.

Begin with `feasible_sets`.
"""
