"""Simulators: robots among landmarks, inertial units with a receiver, a car; begin with `landmarks`.

The scenarios of families are in `fuselog.recorders.families`.
"""
