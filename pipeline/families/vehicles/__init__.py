"""Studies of cooperative vehicles (Zhang et al. 2016); begin with `study`."""
