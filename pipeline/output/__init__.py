"""Files, result folders, tables, charts and reports that commands write.

Begin with `results`.
"""

RESULT_FILE = "result.json"  # marks a folder as a result folder
