"""Importers of real data of any kind: tables, ROS, ULog, and robots among landmarks.

Begin with `tables`, for CSV and similar files. The importers for data sets of families are in
`fuselog.recorders.families`.
"""
