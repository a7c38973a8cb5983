"""The replay itself: estimators, late messages, and what is watched meanwhile.

Begin with `replaying`.
"""
