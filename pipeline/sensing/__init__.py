"""Finds what noise sensors have, by recordings of them, with intervals, and how filters state it.

Begin with `noise`. The mathematics stands in `terms`, `allan`, `likelihood` and `fitting`, over columns.
"""
