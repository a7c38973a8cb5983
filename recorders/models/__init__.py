"""Motion and measurement models: written once, for simulators and estimators alike.

Begin with `planar`, the robot's.
"""
