"""Runs of one model by one method over messages: events, recursion, initialization and reprocessing.

Begin with `recursion`.
"""
