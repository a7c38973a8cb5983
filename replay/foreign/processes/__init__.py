"""Processes for filters: started, watched, ended if necessary, and replaced.

Begin with `isolation`; `streaming` has the programs that answer messages.
"""
