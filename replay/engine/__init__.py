"""Replay of an ensemble of runs in time order, in one pass, through several estimators.

Begin with `streams.blocks`, which defines the data, and `replaying.replaying`, which runs the replay.
"""
