"""Review of runs, from results or folders of logs, as a dataset in Rerun; begin with `command`."""
