"""Studies of lines of sight, for Belfadel et al. 2014 and for moving sensors; begin with `study`."""
