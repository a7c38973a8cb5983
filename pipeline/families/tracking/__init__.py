"""Studies trackers: vessels, ferries, targets that cross; begin with `study`.

Writes tracks for the MOT Challenge, too.
"""
