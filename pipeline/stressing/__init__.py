"""Replays of a log under changes that should not matter, and a verdict on whether its result is robust.

Begin with `stressing`.
"""
