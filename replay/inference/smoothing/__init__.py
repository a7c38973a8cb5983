"""Smoothers: the backward pass over a filter, iterated smoothing, and the bound of all of it.

Begin with `backward_pass`.
"""
