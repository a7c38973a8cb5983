"""Models: their definition, their binding to a log, and additions to their state.

Begin with `model`.
"""
