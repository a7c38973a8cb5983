"""Compilation of kernels that create no arrays, from Python source to machine code in milliseconds.

Such a kernel is a plain Python function of numbers, arrays, tuples and NamedTuples, with all functions
that it calls. `lowering` goes through its source once for the given types and sizes, and writes LLVM IR.
Expressions of values that are already known (sizes, kinds of components, called functions) are evaluated
by Python during this pass, and add no code. Begin reading in `native`, which caches, loads and calls
kernels.
"""
