"""Models of motion and measurements, shared by simulators and estimators.

Begin with `planar`, which models a robot. Models of single families are in `fuselog.recorders.families`.
"""
