"""Estimation of sensor noise from recordings, with intervals, and its export to filters.

Begin with `noise`. The mathematics is in `terms`, `allan`, `likelihood` and `fitting`, over columns.
"""
