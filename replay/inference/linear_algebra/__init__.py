"""Linear algebra of small matrices in place, and states on their manifold.

Begin with `gaussian`.
"""
