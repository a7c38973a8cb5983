"""Reads ULog, the logs of PX4 autopilots; begin with `importer`.

Source: docs.px4.io, ULog File Format, version 1. `formats` lays out messages, `file` reads a file in
blocks, `sensors` says what becomes of which topic, `estimator` what of the autopilot's filter.
"""
