"""Replays a log under changes that should not matter, and says whether its result is one.

Begin with `stressing`.
"""
