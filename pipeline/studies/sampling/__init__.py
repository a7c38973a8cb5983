"""Studies densities and samples: Bingham, torus, LCD sampling, the S2KF's systems.

Begin with `bingham`.
"""
