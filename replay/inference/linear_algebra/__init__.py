"""In-place linear algebra with small matrices, and operations on states on a manifold.

Begin with `gaussian`.
"""
