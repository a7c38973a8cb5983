"""Processes for filters, which are started, watched, ended if necessary, and replaced.

Begin with `isolation`; `streaming` is for programs that answer messages.
"""
