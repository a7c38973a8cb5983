"""Alteration of a run's topics before a replay, to correct a fault or to plant one.

Begin with `sources`.
"""
