"""Tests whether errors, innovations and scores agree with the uncertainty that an estimator states.

Begin with `consistency`. NEES is computed with the errors, in
`fuselog.replay.judging.errors.evaluation`.
"""
