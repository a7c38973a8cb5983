"""Describes how states move and are measured, and estimates any such state by any method.

Begin with `model.model`, then `estimators`, which joins a model and a method, and `run`.
"""
