"""Traces of models as expression graphs: each function is called once with traced numbers.

The graph of a function provides its exact derivatives (`derivatives`), its machine code (`emission`) and
readable formulas (`formulas`). Begin with `functions`, whose classes wrap a model's functions.
"""
