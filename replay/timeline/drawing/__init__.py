"""What scenes of any family are drawn with: canvas, plane, plots; begin with `canvas`."""
