"""Comparison of new replays with stored ones, field by field; begin with `checking`."""
