"""Estimators and models of the core: robots, inertial units, batch least squares.

Begin with `landmarks`. Methods that estimate models, such as `ekf`, are in `fuselog.replay.inference`;
families have their own estimators in `fuselog.replay.families`.
"""
