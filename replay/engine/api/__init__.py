"""Estimators made from plain functions, and the types that these functions receive and return.

Begin with `functions`.
"""
