"""Processing of messages by one model and one method: events, recursion, start and reprocessing.

Begin with `recursion`.
"""
