"""Writes what commands leave: files, result folders, tables, charts, reports.

Begin with `results`.
"""
