"""The C code of a filter: templates, and what fills them, generated from the graphs of its steps.

Begin with `filter`, which renders the template filter.c; the template includes the others, such as
update.c, the update that all filters share.
"""
