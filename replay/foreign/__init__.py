"""Foreign filters in a replay: libraries with the functions of `fuselog_filter.h`, and programs.

Begin with `filters`, which makes estimators from them; `description` defines the description of a
filter.
"""
