"""One pass in time order over the runs of an ensemble, through several estimators at once."""
