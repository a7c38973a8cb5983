"""Positions from angles and arrival times, by batch least squares; begin with `least_squares`."""
