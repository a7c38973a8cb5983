"""Draws one timeline per scenario family: which scenes it has and how they are laid out.

Begin with `landmarks`.
"""
