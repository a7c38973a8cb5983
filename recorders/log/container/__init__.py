"""The MCAP container: chunks, indexes, and a file that appears whole or not at all.

Begin with `reading`.
"""
