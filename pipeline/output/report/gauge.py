"""Computes the gauge of a card: where NEES or NIS lies between too careful and too sure."""

import math
from typing import NamedTuple

from fuselog.pipeline.output.report.evidence import MATERIAL, Consistency
from fuselog.pipeline.output.words import Scale, alike, interval, number

# It goes from a third of the aim to ten times the aim, evenly in the logarithm.
GAUGE_ENDS = (1 / 3, 10.0)


class Gauge(NamedTuple):
    """Shows where a mean of squares lies, in percent of a scale from too careful to too sure.

    Attributes:
        honest: what counts as consistent: where 95 % of such estimators lie, and what is off by little.
        aim, value: the right value, and the one that was found.
        spread: where the latter lies with 95 %; both ends at it where that is not known.
        is_beyond: whether the value lies beyond the scale's end.
        words: the same for who cannot see it.
    """

    honest: tuple[float, float]
    aim: float
    value: float
    spread: tuple[float, float]
    is_beyond: bool
    words: str


def numbers_of(by: Consistency) -> str:
    """Return the mean of squares with its interval, and what is right."""
    name = "NIS per component" if by.name == "NIS" else by.name
    if not by.found.is_known:
        return f"{name} {number(by.found.value)}; {number(by.aim)} is right"
    found, low, high = alike(by.found, Scale())
    return f"{name} {found}, 95 % {low} to {high}; {number(by.aim)} is right"


def gauge(by: Consistency) -> Gauge:
    """Return where a mean of squares lies on its scale."""

    def place(value: float) -> float:
        low, high = map(math.log, GAUGE_ENDS)
        share = (math.log(max(value, 1e-12) / by.aim) - low) / (high - low)
        return round(100.0 * min(max(share, 0.0), 1.0), 2)

    low, high = by.honest
    found = by.found
    spread = (found.low, found.high) if found.is_known else (found.value, found.value)
    words = f"{numbers_of(by)}; a consistent estimator lies from {interval(low, high, Scale())}"
    is_beyond = not GAUGE_ENDS[0] < found.value / by.aim < GAUGE_ENDS[1]
    ends = (place(spread[0]), place(spread[1]))
    box = min(low, (1.0 - MATERIAL) * by.aim), max(high, (1.0 + MATERIAL) * by.aim)
    return Gauge(
        (place(box[0]), place(box[1])), place(by.aim), place(found.value), ends, is_beyond, words
    )
