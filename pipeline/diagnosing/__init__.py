"""Diagnosis of inconsistent estimators, which finds the faults whose correction makes them consistent.

Begin with `diagnosis`; `hypotheses` contains the possible faults.
"""
