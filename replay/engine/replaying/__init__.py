"""Replay of messages through estimators, in time order or in order of arrival, and monitoring of runs.

Begin with `replaying`.
"""
