"""Simulators of lines of sight from optical sensors to targets; begin with `simulator`."""
