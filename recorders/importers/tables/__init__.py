"""Importer of tables, such as CSV files: a mapping defines the meaning of their columns.

Begin with `rows`, which makes streams from the rows of one file; `importer` combines all files.
"""
