"""Alters topics of a run at the source of any replay: a fault is undone, or put in.

Begin with `sources`.
"""
