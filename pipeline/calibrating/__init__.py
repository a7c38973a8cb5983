"""Calibration of mountings, scales, biases and delays of sensors.

Begin with `calibrating`, which searches for the parameters that a model marks, with
`fuselog.pipeline.tuning`.
"""
