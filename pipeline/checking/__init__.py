"""Comparison of replays with stored ones, field by field; begin with `checking`."""
