"""The Rerun timeline: sinks, columns, and one blueprint per scenario family; begin with `show`."""
