"""Runs of experiments: ensembles are recorded, replayed and judged, in cells and sweeps.

Begin with `ensemble`.
"""
