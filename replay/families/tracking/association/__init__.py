"""Prediction, association and update of the tracks of the estimator `tracker`; begin with `tracking`.

The package above reads that estimator's input from a log and writes its output. Of the other two
trackers only `report_tracker` uses parts of this package: greedy association, and sums over joint
associations.
"""
