"""The command line, experiments, Monte Carlo runs and reports; begin with `api`, then `runs`."""
