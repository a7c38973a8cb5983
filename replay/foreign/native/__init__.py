"""Filters behind `fuselog_filter.h`: their library, and the loop that calls it by address.

Begin with `following`.
"""
