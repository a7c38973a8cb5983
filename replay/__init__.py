"""Estimators, metrics, error bounds and the timeline: everything that reads a log and estimates states.

Begin with `engine.replaying.replaying`, the pass that all of it hangs on.
"""
