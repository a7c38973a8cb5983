"""Studies, one file per family: which tables, figures and claims an experiment yields."""
