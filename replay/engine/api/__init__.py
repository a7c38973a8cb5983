"""Makes estimators from plain functions, and defines what these are given and return.

Begin with `functions`.
"""
