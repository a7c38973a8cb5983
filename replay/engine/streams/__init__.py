"""Lays streams of many runs end to end, reads them, and makes streams of what estimators return.

Begin with `blocks`.
"""
