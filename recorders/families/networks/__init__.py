"""Simulates networks of nodes that track a target; begin with `ispace`."""
