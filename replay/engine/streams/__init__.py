"""Streams of many runs laid end to end, where they are read from, and what estimators make of them.

Begin with `blocks`.
"""
