"""Importer of ULog, the logs of PX4 autopilots; begin with `importer`.

Source: docs.px4.io, ULog File Format, version 1. `formats` parses message formats, `file` reads a file
in blocks, `sensors` converts the topics of sensors, and `estimator` converts the topics of the
autopilot's filter.
"""
