"""Simulators and importers of axes, orientations and headings; begin with `orientation`."""
