"""Filters of axes, orientations and pairs of angles; begin with `estimators`."""
