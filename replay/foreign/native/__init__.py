"""Calls filters behind `fuselog_filter.h`: loads their library, and calls it by address.

Begin with `following`.
"""
