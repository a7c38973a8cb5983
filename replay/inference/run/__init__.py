"""Processing of messages by one model and one method, from events to reprocessing.

Begin with `recursion`.
"""
