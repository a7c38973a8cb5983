"""Reading logs into estimators, the estimators, metrics and bounds, and the timeline."""
