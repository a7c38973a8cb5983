"""Studies sensor networks and robots that share estimates; begin with `networks`."""
