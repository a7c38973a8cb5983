"""Alterations of a run's topics, which correct a fault or plant one before any replay.

Begin with `sources`.
"""
