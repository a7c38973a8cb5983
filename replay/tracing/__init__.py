"""Traces models as expression graphs: calls each function once with traced numbers.

From the graph of a function come its exact derivatives (`derivatives`), its machine code (`emission`),
the formulas that a person reads (`formulas`). Begin reading in `functions`, which is what models are
wrapped in.
"""
