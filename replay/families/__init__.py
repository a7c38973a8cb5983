"""Estimates, judges and draws what single families of systems need; a package each.

Nothing outside imports them: estimators, models, metrics, judges, drawings and timelines register. One
family may use another. Begin with a small one, `ranging`.
"""
