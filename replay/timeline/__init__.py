"""Rerun timelines: sinks, drawing, and the scenes of robots and inertial units; begin with `show`.

Families draw their scenes in `fuselog.replay.families`; `generic` draws logs without a registered scene.
"""
