"""The C code of a filter, its header and its source, generated from the graphs of its steps.

Begin with `filter`, which writes the functions; `algebra` contains the update that all filters share.
"""
