"""Linear algebra with small matrices in place, and operations on states on their manifold.

Begin with `gaussian`.
"""
