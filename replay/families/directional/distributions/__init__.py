"""Distributions of axes, of orientations and on the torus; begin with `bingham`."""
