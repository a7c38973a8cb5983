"""Tables of others, such as CSV files, as logs: what their columns are is said by a mapping.

Begin with `importer`.
"""
