"""Holds estimators, one room per family, and models that any method estimates; begin with `models`."""
