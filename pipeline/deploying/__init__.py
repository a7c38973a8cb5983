"""A filter as C99 for a robot: `fuselog deploy`.

Begin reading in `deploying`, which chooses and writes. `c_filter` makes the filter of the graphs of its
steps, `c_algebra` is the update that all have in common; `c_replay` lets fuselog replay it, and `c_test`
makes a recorded log its test.
"""
