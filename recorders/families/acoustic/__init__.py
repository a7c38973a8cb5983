"""Records shots and sounds that arrays of microphones hear; begin with `simulator`.

That is one shot after the other. `shot_sequence` and `sound_source` are scenarios of their own: shots of
a shooter who moves, and a sound heard by microphones; `sound_recordings` imports real ones.
"""
