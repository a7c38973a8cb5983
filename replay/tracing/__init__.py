"""Tracing of models to expression graphs, by calling their functions with traced numbers.

Exact derivatives (`derivatives`), machine code (`emission`) and readable formulas (`formulas`) of a
function are made from its graph. Begin with `functions`, whose classes wrap the functions of a model.
"""
