"""Computes with distributions on the torus, of axes and of orientations; begin with `bingham`."""
