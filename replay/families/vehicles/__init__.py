"""Filters several cooperative vehicles jointly, with unordered fixes.

Begin with `streams`.
"""
