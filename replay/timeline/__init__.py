"""Rerun timelines: sinks, columns, the scenes of robots and inertial units; begin with `show`.

Families draw their scenes in `fuselog.replay.families`; `generic` draws a log without a registered
scene.
"""
