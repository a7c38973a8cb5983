"""Tries what may be wrong: alternatives to a log and the settings it is replayed with.

Every alternative is a trial as it would be without the fault; what that gains in log-likelihood says
how likely the fault is. What is tried follows from what the model's functions read, not from names.
Begin with `listing`, which lists them; `hypothesis` says what one is.
"""
