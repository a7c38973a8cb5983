"""The log format, models of sensors and motion, the simulators, and the importers of real data.

Begin with `recording`, which defines what a recorder is, and `log`.
"""
