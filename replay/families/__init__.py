"""Estimators, judges and drawings that are specific to a family of systems; one package per family.

No module outside this package imports a family: estimators, models, metrics, judges, drawings and
timelines register themselves. One family may use another. Begin with `ranging`, a small family.
"""
