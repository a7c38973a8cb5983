"""Hypotheses on possible faults of a log, or of the settings of its replay.

In a trial, the assumed fault is corrected; the gain in log-likelihood measures how likely the fault is.
The hypotheses are derived from the inputs of the model's functions, not from names. Begin with
`listing`, which lists the hypotheses; `hypothesis` defines what a hypothesis is.
"""
