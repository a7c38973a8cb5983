"""Filters with the functions of `fuselog_filter.h`: loading of libraries, and calls by address.

Begin with `following`.
"""
