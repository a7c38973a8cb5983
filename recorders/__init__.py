"""The log, sensor and motion models, the simulators and the importers of real data.

Begin with `recording`, which defines what a recorder is, and `log`.
"""
