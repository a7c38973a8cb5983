"""Draws the Rerun timeline: sinks, columns, one blueprint per scenario family; begin with `show`."""
