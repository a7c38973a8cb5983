"""Runs filters in processes of their own: watched, ended where they must be, and replaced.

Begin with `isolation`; `streaming` has the programs that answer messages.
"""
