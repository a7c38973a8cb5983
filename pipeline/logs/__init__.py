"""Logs as files: information, editing and export; begin with `information`."""
