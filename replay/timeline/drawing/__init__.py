"""Elements of scenes for any family, such as the canvas, planes and plots; begin with `canvas`."""
