"""Filters of others in a replay: a library behind `fuselog_filter.h`, a program, a program that streams.

Begin with `filters`, which makes estimators of them; `description` has what a filter says of itself.
"""
