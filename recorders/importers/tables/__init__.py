"""Imports tables of others, such as CSV files: a mapping says what their columns are.

Begin with `rows`, which makes streams of the rows of one file; `importer` takes all files together.
"""
