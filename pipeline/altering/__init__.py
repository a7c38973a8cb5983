"""Altering: topics of a run with a fault undone, or put in, at the source of any replay."""
