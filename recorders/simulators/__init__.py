"""Simulates sensor streams, one file per scenario family; begin with `landmarks`."""
