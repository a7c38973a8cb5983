"""Diagnosis of inconsistent estimators by the faults without which they would be consistent.

Begin with `diagnosis`; `hypotheses` has the faults.
"""
