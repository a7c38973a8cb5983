"""Checks a log as it is written: units, stamps, frames, covariances, single columns, names.

Begin with `lint`: one check is one function of a topic and all others, in a table. What needs topics
compared in pairs is `fuselog.recorders.plausibility`, which a lint asks as well.
"""
