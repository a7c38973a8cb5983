"""Studies of cooperative vehicles after Zhang et al. 2016; begin with `study`."""
