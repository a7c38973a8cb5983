"""Prediction, association and update of the tracks of the estimator `tracker`; begin with `tracking`.

The parent package reads the input of that estimator from a log and writes its output. `report_tracker`
also uses parts of this package: greedy association, and sums over joint associations.
"""
