"""Estimators for networks of nodes and robots that share estimates; begin with `estimator`."""
