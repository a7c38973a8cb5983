"""Offers what `import fuselog` gives, on which the commands rest; begin with `replays` and `api`."""
