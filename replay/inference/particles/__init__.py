"""Particle filters for any model; begin with `particles`."""
