"""Studies of lines of sight: Belfadel et al. 2014, and moving sensors; begin with `study`."""
