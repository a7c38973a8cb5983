"""Particle filters of any model; begin with `particles`."""
