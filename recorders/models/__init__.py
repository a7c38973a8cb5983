"""Models motion and measurements once, for simulators and estimators alike.

Begin with `planar`, the robot's. What one family needs is in `fuselog.recorders.families`.
"""
