"""Records axes, orientations and headings; begin with `orientation`."""
