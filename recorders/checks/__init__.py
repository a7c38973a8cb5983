"""Checks of a log that need no filter: units, stamps, frames, covariances, columns, motion.

Begin with `lint`, which has the checks in a table: each check is a function. `finding` defines the
result of a check, `body` collects the topics of one body, and `motion` compares them in pairs. Checks
that need a filter's innovations or errors are in `fuselog.pipeline`.
"""
