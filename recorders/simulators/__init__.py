"""Simulates robots among landmarks, inertial units with a receiver, and a car; begin with `landmarks`.

The scenarios of families are in `fuselog.recorders.families`.
"""
