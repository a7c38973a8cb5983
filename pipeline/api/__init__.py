"""The Python interface behind `import fuselog` and the commands; begin with `replays` and `api`."""
