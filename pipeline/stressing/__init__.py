"""Tests of whether a result is robust, by replays of a log under changes that should not matter.

Begin with `stressing`.
"""
