"""Estimation of sensor noise from recordings, with intervals, and its output for filters.

Begin with `noise`. The mathematics is in `terms`, `allan`, `likelihood` and `fitting`.
"""
