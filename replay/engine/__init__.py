"""Replays an ensemble of runs in time order, in one pass, through several estimators at once."""
