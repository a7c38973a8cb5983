"""Compiles loops over runs from plain Python functions, and keeps the machine code.

Begin with `compile`. Under which key code is kept, `kernels.native` says for our own compiler, and
`kernel_cache` for numba.
"""
