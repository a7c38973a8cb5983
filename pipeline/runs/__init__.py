"""Runs of experiments: ensembles that are recorded, replayed and judged, in cells and sweeps.

Begin with `ensemble`.
"""
