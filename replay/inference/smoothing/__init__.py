"""Smooths: the backward pass over a filter, iterated smoothing, and the posterior bound.

Begin with `backward_pass`.
"""
