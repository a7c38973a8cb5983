"""Joint filters of several cooperative vehicles whose fixes are unordered.

Begin with `streams`.
"""
