"""Alterations of a run's topics at the source of any replay, to correct a fault or to plant one.

Begin with `sources`.
"""
