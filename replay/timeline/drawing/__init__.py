"""Draws scenes of any family: canvas, plane, plots; begin with `canvas`."""
