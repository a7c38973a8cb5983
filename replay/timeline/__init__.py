"""Draws the Rerun timeline: sinks, columns, the scenes of robots and inertial units; begin with `show`.

Families draw theirs in `fuselog.replay.families`; `generic` draws a log of which no scene is registered.
"""
