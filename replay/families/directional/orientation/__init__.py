"""Estimators of orientation from inertial and magnetic samples; begin with `estimators`."""
