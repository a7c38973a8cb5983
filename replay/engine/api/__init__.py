"""Estimators from plain functions: what they are given and what they return.

Begin with `functions`.
"""
