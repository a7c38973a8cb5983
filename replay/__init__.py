"""Reads logs into estimators, and holds the estimators, metrics and bounds, and the timeline.

Begin with `engine.replaying.replaying`, the pass that all of it hangs on.
"""
