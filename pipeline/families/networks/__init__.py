"""Studies of networks, robots and inertial units that share estimates; begin with `study`."""
