"""Evaluation of estimates against the truth: errors, consistency, metrics; begin with `judge`.

Families register judges for other outputs, such as sets and tracks; see `kinds`.
"""
