"""Judging of estimates by truth: errors, consistency, metrics; begin with `judge`.

Families register what they judge in addition, such as sets and tracks; see `kinds`.
"""
