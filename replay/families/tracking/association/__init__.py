"""Prediction, association and update of the tracks of the estimator `tracker`; begin with `tracking`.

The package above reads that estimator's input from a log and writes its output. The tracker
`report_tracker` also uses parts of this package: greedy association, and sums over joint associations.
"""
