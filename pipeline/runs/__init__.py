"""Runs of experiments: ensembles recorded, replayed and judged, in cells and sweeps.

Begin with `ensemble`.
"""
