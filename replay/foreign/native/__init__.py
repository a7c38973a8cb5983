"""Filters behind `fuselog_filter.h`: loading of their library, and calls by address.

Begin with `following`.
"""
