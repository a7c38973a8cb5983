"""Imports real data of any kind: tables, ROS, ULog, and robots among landmarks; begin with `mrclam`.

Data sets of families are imported in `fuselog.recorders.families`.
"""
