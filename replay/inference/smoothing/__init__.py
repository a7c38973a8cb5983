"""Smoothers with a backward pass over a filter or with iteration, and the posterior bound.

Begin with `backward_pass`.
"""
