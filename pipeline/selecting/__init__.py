"""Folders and catalogs of logs, and the logs that a command selects; begin with `catalog`."""
