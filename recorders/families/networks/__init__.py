"""Simulates a room of networked nodes that follow one target; begin with `ispace`.

It has nothing else: robots and inertial units that share estimates are imported by
`fuselog.recorders.importers`.
"""
