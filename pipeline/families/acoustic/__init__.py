"""Studies of sounds and shots: Osborne et al. 2014, recordings, sequences.

Begin with `study`.
"""
