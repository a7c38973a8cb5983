"""Reading and writing of MCAP: chunks, indexes, and files that appear completely or not at all.

Begin with `reading`.
"""
