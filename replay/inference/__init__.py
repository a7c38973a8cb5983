"""Models (how states move and are measured) and the methods that estimate the state of any model.

Begin with `model.model`, then `estimators`, which joins a model and a method, and `run`.
"""
