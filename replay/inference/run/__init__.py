"""Runs one model by one method over messages: events, the recursion, initialization, late messages.

Begin with `recursion`.
"""
