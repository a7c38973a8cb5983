"""Predicts, associates and updates the tracks of the estimator `tracker`; begin with `tracking`.

What that estimator reads of a log and writes is in the package above. Of the other two trackers only
`report_tracker` uses something of this: pairs by the nearest, and sums over joint associations.
"""
