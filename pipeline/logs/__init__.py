"""Logs as files: information, editing, and export for other tools; begin with `information`."""
