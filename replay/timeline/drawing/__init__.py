"""Elements for the scenes of any family: canvas, plane, plots; begin with `canvas`."""
