"""Diagnoses why an estimator is inconsistent, by the faults without which it would not be.

Begin with `diagnosis`; `hypotheses` has the faults.
"""
