"""What commands leave behind: files, result folders, tables, charts, reports.

Begin with `results`.
"""
