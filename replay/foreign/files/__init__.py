"""Writes what programs that read a log are given, and reads what they write.

Begin with `estimates`.
"""
