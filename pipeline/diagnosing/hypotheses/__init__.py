"""Hypotheses on possible faults, as alternatives to a log and to the settings of its replay.

Each alternative is a trial without the assumed fault, whose gain in log-likelihood measures how likely
the fault is. The hypotheses are derived from the inputs of the model's functions, not from names.
Begin with `listing`, which lists them; `hypothesis` defines one.
"""
