"""Models of motion and measurements, shared by simulators and estimators.

Begin with `planar`, the robot's. Models of single families are in `fuselog.recorders.families`.
"""
