"""Positions from angles and arrival times, by least squares over batches; begin with `acoustic`."""
