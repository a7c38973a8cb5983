"""Studies of trackers: vessels, ferries and crossing targets; begin with `study`.

`mot` exports tracks in the format of the MOT Challenge.
"""
