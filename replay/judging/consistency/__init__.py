"""Tests whether errors, innovations and scores agree with what an estimator states about them.

Begin with `consistency`. NEES is computed with the errors, in
`fuselog.replay.judging.errors.evaluation`.
"""
