"""The C code of a filter, its header and its source, from the graphs of its steps.

Begin reading in `filter`, which writes the functions; `algebra` is the update that all have in common.
"""
