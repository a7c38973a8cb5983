"""Judging of estimates by truth: errors, consistency, metrics; begin with `judge`.

What families judge in addition, such as sets and tracks, is registered; see `kinds`.
"""
