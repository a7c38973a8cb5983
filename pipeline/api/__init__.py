"""The Python functions of `import fuselog` and of the commands; begin with `replays` and `api`."""
