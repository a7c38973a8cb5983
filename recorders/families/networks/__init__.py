"""Simulator of a room of networked nodes that track one target; begin with `ispace`.

Robots and inertial units that share estimates are imported by `fuselog.recorders.importers`.
"""
