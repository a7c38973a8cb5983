"""Compilation of kernels that make no arrays: from Python's source to machine code in milliseconds.

Such a kernel is a plain Python function of numbers, arrays, tuples and NamedTuples, with all functions
that it calls. `lowering` goes through its source once for the given types and sizes, and writes LLVM's
text. What is already known (sizes, kinds of components, the called functions) is evaluated at the same
time, as Python would, and adds no code. Begin reading in `native`, which caches, loads and calls
kernels.
"""
