"""Metrics: how errors become the numbers of all that is judged; begin with `measuring`."""
