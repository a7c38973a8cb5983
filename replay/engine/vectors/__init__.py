"""Describes vectors by the names of their components, their tangent spaces and covariances.

Begin with `tangent`.
"""
