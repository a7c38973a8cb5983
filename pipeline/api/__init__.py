"""What `import fuselog` offers, on which the commands rest; begin with `replays` and `api`."""
