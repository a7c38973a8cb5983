"""The command line, experiments, Monte Carlo execution and reports; begin with `api`, then `runs`."""
