"""Cooperative vehicles: joint filters of several vehicles with unordered fixes.

Begin with `streams`.
"""
