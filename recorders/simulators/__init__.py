"""Simulates robots among landmarks, and inertial units with a receiver; begin with `landmarks`.

The scenarios of families are in `fuselog.recorders.families`.
"""
