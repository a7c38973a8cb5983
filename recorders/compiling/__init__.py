"""Compilation of plain Python functions to loops over runs, and the cache of their machine code.

Begin with `compile`. The keys of cached code are defined in `kernels.native`.
"""
