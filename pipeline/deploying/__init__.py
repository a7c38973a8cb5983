"""Filters in C99 for a robot, written by `fuselog deploy`.

Begin with `deploying`, which writes the folder. `c_source` writes the filter itself, `c_replay` writes
an interface with which fuselog can replay it, and `c_test` writes a test from a recorded log.
"""
