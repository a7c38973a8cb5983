"""Logs at URLs that fsspec knows: paths that name them, and copies of them in the user's cache.

Begin with `paths`.
"""
