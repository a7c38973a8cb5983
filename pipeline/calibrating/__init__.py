"""Calibration of mountings, scales, biases and delays of sensors.

Begin with `calibrating`, which uses `fuselog.pipeline.tuning` to estimate the calibration parameters of
a model.
"""
