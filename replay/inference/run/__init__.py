"""One model by one method over the messages of runs: events, the recursion, its start, late messages.

Begin with `recursion`.
"""
