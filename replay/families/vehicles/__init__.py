"""Joint filters of several cooperative vehicles, with unordered fixes.

Begin with `streams`.
"""
