"""Filters written as C99 for a robot: `fuselog deploy`.

Begin reading in `deploying`, which chooses and writes. `c_source` writes the filter itself; `c_replay`
lets fuselog replay it, and `c_test` turns a recorded log into its test.
"""
