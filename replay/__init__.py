"""Reading logs into estimators, the estimators, metrics and bounds, and the timeline.

Begin with `engine.replaying.replaying`, the pass that all of it hangs on.
"""
