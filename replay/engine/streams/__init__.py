"""Streams of many runs end to end: reading, merging in time order, and making output streams.

Begin with `blocks`.
"""
