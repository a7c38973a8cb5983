"""Imports real data, one file or package per source; begin with `mrclam`."""
