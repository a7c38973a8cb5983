"""Defines the verdicts that commands, reports and result.json give: one enum a question.

Whether an estimator is overconfident is decided by `Squares.verdict` alone; all others ask it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from fuselog.replay.judging.intervals import Interval

# A mean of squares may be off by this share: nobody would act on less, however many runs show it.
MATERIAL = 0.1
FAR = 1.25  # times larger than claimed: errors of that are no matter of a few percent
# Squared errors so many times too large are no matter of covariances: 10,000 standard deviations.
DIVERGED = 1e8


class Consistency(StrEnum):
    """Answers whether errors are as large as an estimator's covariances say."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    UNDECIDED = "undecided"


class Comparison(StrEnum):
    """Answers whether a second estimator is better than a first.

    Of a metric that has no right value it is only higher or lower. The answer is withheld if changes
    that should not matter move the metric further than the two differ.
    """

    BETTER = "better"
    WORSE = "worse"
    HIGHER = "higher"
    LOWER = "lower"
    TIE = "tie"
    UNDECIDED = "undecided"
    WITHHELD = "withheld"

    @classmethod
    def _missing_(cls, value: object) -> "Comparison | None":
        """Read what results of before said."""
        return {"no difference": cls.TIE, "unclear": cls.UNDECIDED}.get(str(value))


# Verdicts on a difference beyond chance and margin, and those on two that are not told apart.
DIFFER = (Comparison.WORSE, Comparison.BETTER, Comparison.HIGHER, Comparison.LOWER)
ALIKE = (Comparison.TIE, Comparison.UNDECIDED, Comparison.WITHHELD)


class Claimed(StrEnum):
    """Answers whether a claim holds; there is no verdict if it is made of another recording."""

    CONFIRMED = "confirmed"
    REFUTED = "refuted"
    INCONCLUSIVE = "inconclusive"
    NOT_REPRODUCIBLE = "not reproducible"
    NO_VERDICT = "no verdict"

    @classmethod
    def _missing_(cls, value: object) -> "Claimed | None":
        """Read what results of before said."""
        return cls.INCONCLUSIVE if value == "not shown" else None


@dataclass(frozen=True)
class Squares:
    """Holds a mean of normalised squares, NEES or NIS per component.

    Attributes:
        name: which of the two.
        found: the mean, with its interval over the runs if there are enough.
        aim: what it should be.
        usual: where it lies with 95 % if the estimator is consistent.
    """

    name: str
    found: Interval
    aim: float
    usual: tuple[float, float]

    @property
    def verdict(self) -> Consistency:
        """Decide what it says of the estimator: by chance over covariances, and over the runs."""
        low, high = self.usual
        if math.isnan(self.found.value):
            return Consistency.UNDECIDED
        is_excluded = self.found.is_bounded and not self.found.low <= self.aim <= self.found.high
        is_usual = low <= self.found.value <= high and not is_excluded
        if is_usual or abs(self.found.value / self.aim - 1.0) <= MATERIAL:
            return Consistency.CONSISTENT
        is_large = self.found.value > (self.aim if is_excluded else high)
        return Consistency.OVERCONFIDENT if is_large else Consistency.CONSERVATIVE

    @property
    def factor(self) -> float:
        """Return how many times larger errors are than the estimator claims."""
        return math.sqrt(max(self.found.value, 0.0) / self.aim)

    @property
    def is_far(self) -> bool:
        """Tell whether errors are so far beyond what is claimed that the covariance is no guide."""
        return self.factor > FAR

    @property
    def has_diverged(self) -> bool:
        """Tell whether errors are so large that they are no matter of covariances."""
        return self.found.value > DIVERGED * self.aim


def decisive(squares: Sequence[Squares]) -> Squares | None:
    """Return the one that decides of an estimator: the first that is not consistent, else the first."""
    off = (each for each in squares if each.verdict != Consistency.CONSISTENT)
    return next(off, squares[0] if squares else None)
