"""Studies trackers: vessels, ferries, targets that cross; begin with `tracking`."""
