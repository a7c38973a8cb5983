"""Smooths by a backward pass over a filter, or by iteration, and computes the posterior bound.

Begin with `backward_pass`.
"""
