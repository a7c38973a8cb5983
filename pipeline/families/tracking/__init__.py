"""Studies of trackers: vessels, ferries, crossing targets; begin with `study`.

The package also writes tracks for the MOT Challenge.
"""
