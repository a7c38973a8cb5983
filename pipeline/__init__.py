"""The command line, experiments, Monte Carlo execution and reports."""
