"""Defines what a model is, how a log serves it, and what may be added to its state.

Begin with `model`.
"""
