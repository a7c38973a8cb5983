"""Estimators made from plain functions, and the types that these functions are given and return.

Begin with `functions`.
"""
