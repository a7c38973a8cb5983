"""Estimates any model's state by particles; begin with `particles`."""
