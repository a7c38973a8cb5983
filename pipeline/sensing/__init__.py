"""What sensors are like, by recordings of them: their noise, with intervals, and how filters state it.

Begin with `noise`. The mathematics stands in `terms`, `allan`, `likelihood` and `fitting`, over columns.
"""
