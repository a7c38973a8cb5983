"""Finds what is wrong with a log without a filter: units, stamps, frames, covariances, columns, motion.

Begin with `lint`, which has the checks in a table: one check is one function. `finding` has what a check
finds, `body` what topics say of one body, which `motion` compares in pairs. What needs a filter's
innovations or errors is in `fuselog.pipeline`.
"""
