"""Vectors described by the names of their components, their tangent spaces and covariances.

Begin with `tangent`.
"""
