"""Compiles kernels that make no arrays: from Python's source to machine code in milliseconds.

Such a kernel is a plain Python function of numbers, arrays, tuples and NamedTuples, with all that it
calls. `lowering` goes through its source once for the types and sizes at hand and writes LLVM's text:
what is known already (sizes, kinds of components, which function is called) is worked out meanwhile,
as Python would, and leaves no trace. Begin reading in `native`, which keeps, loads and calls them.
"""
