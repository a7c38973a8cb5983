"""Studies of axes, orientations and headings on the torus; begin with `bingham`."""
