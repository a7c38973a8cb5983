"""Models of motions and sensors, and methods that estimate the state of any model.

Begin with `model.model`; then read `estimators`, which combines a model and a method, and `run`.
"""
