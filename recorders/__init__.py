"""Holds the log, sensor and motion models, the simulators and the importers of real data.

Begin with `recording`, which says what a recorder is, and `log`.
"""
