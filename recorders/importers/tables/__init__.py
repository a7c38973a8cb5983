"""Imports tables of others, such as CSV files: a mapping says what their columns are.

Begin with `importer`.
"""
