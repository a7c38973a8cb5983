"""Hypotheses on what may be wrong: alternatives to a log and to the settings of its replay.

Each alternative is a trial without the assumed fault; its gain in log-likelihood tells how likely the
fault is. The hypotheses follow from what the model's functions read, not from names. Begin with
`listing`, which lists them; `hypothesis` defines one.
"""
