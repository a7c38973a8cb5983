"""Estimators, judges and drawings of single families of systems, a package for each family.

Nothing outside imports these packages: estimators, models, metrics, judges, drawings and timelines
register themselves. One family may use another. Begin with a small one, `ranging`.
"""
