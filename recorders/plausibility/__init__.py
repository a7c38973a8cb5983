"""Finds what a log says of its own faults before any filter: speeds, courses, forces, stamps.

Begin with `checks`: one check is one function, in a table; what they read of a log is a `body`.
"""
