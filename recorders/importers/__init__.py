"""Imports real data of any kind: tables, ROS, ULog, and robots among landmarks.

Begin with `tables`, for CSV and its like. Data sets of families are imported in
`fuselog.recorders.families`.
"""
