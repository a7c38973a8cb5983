"""Methods that run several filters in parallel: interacting multiple models, and Gaussian sums.

Begin with `imm`.
"""
