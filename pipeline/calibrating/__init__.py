"""Finds how sensors are mounted, scaled, biased and delayed, and which motion tells it.

Begin with `calibrating`, which frees what a model marks for the search of `fuselog.pipeline.tuning`.
"""
