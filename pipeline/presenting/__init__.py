"""Runs of results and folders of logs, reviewed as a dataset in Rerun; begin with `command`."""
