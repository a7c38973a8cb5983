"""Recordings of shots and sounds heard by arrays of microphones; begin with `simulator`.

`simulator` records one shot after another. `shot_sequence` and `sound_source` are separate scenarios:
shots of a moving shooter, and a sound heard by microphones. `sound_recordings` imports real sounds.
"""
