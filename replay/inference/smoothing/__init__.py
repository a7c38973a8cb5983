"""Smoothers, by a backward pass over a filter or by iteration, and the posterior bound.

Begin with `backward_pass`.
"""
