"""Runs filters of others in a replay: a library of `fuselog_filter.h`, or a program, streaming or not.

Begin with `filters`, which makes estimators of them; `description` has what a filter says of itself.
"""
