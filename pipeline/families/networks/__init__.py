"""Studies of networks, robots and units that share estimates; begin with `study`."""
