"""Tests whether errors, innovations and scores are what an estimator says of them.

Begin with `consistency`. NEES is computed with the errors, in
`fuselog.replay.judging.errors.evaluation`.
"""
