"""Runs of one model by one method over messages: events, recursion, initialization, late messages.

Begin with `recursion`.
"""
