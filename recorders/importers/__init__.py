"""Importers of real data of any kind: tables, ROS, ULog, and robots among landmarks.

Begin with `tables`, for CSV and similar files. Importers for the data sets of single families are in
`fuselog.recorders.families`.
"""
