"""Simulators of sensor streams, one file per scenario family."""
