"""Distributions on the torus and on the sphere of axes and orientations; begin with `bingham`."""
