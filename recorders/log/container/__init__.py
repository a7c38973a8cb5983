"""Reads and writes MCAP: chunks, indexes, and a file that appears whole or not at all.

Begin with `reading`.
"""
