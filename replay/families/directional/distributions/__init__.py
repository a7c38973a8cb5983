"""Distributions of axes, of orientations, and of angles on the torus; begin with `bingham`."""
