"""Estimators, metrics, error bounds and the timeline: everything that reads a log and estimates states.

Begin with `engine.replaying.replaying`, the single pass over a log that everything else is built on.
"""
