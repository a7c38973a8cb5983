"""Networks of nodes and robots that share estimates; begin with `networks`."""
