"""Simulators of vehicles with fixes and a roadside sensor; begin with `simulator`."""
