"""Foreign filters in a replay: a library of `fuselog_filter.h`, or a program, streaming or not.

Begin with `filters`, which makes estimators of them; `description` defines how a filter describes
itself.
"""
