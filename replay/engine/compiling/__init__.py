"""Compiles loops over runs from plain Python functions, and keeps the machine code.

Begin with `compile`.
"""
