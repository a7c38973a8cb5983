"""Writes what commands leave: files, result folders, tables, charts, reports.

Begin with `results`.
"""

RESULT_FILE = "result.json"  # says what a result folder is
