"""Imports real data, one file or room per source; begin with `mrclam`."""
