"""The fault campaign: damage done on purpose, and what fuselog makes of it."""

from typing import NamedTuple


class Tally(NamedTuple):
    """How many faults were tried, how many held, and a note for each that did not."""

    tried: int
    held: int
    notes: list[str]
