"""Calibration of mountings, scales, biases and delays of sensors, and which motion determines them.

Begin with `calibrating`, which frees the parameters that a model marks for the search in
`fuselog.pipeline.tuning`.
"""
