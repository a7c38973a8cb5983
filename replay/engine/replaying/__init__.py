"""Replays: takes estimators through messages, in order or late, and monitors their runs.

Begin with `replaying`.
"""
