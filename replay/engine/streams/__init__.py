"""Streams of many runs: how they are read, concatenated, merged in time order, and output.

Begin with `blocks`.
"""
