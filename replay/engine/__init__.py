"""Replays an ensemble of runs in time order, in one pass, through several estimators at once.

Begin with `streams.blocks`, which is what flows, and `replaying.replaying`, which lets it flow.
"""
