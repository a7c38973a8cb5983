"""Verdicts in the output of commands, in reports and in result.json: one enum for each question.

Only `Squares.verdict` decides whether an estimator is overconfident; all other code uses its result.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from fuselog.replay.judging.intervals import Interval

# A mean of squares may deviate by this fraction; less is practically unimportant, even if significant.
MATERIAL = 0.1
FAR = 1.25  # factor on claimed errors, above which a covariance is far from correct
# Squared errors above this multiple (10,000 standard deviations) are divergence, not wrong covariances.
DIVERGED = 1e8


class Consistency(StrEnum):
    """Verdict on whether errors agree with the covariances of an estimator."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    UNDECIDED = "undecided"


class Comparison(StrEnum):
    """Verdict on whether a second estimator is better than a first.

    For a metric without a target value, the verdict is only higher or lower. No verdict is given if
    changes that should not matter change the metric by more than the difference.
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
        """Accept the verdicts of older versions in result.json."""
        return {"no difference": cls.TIE, "unclear": cls.UNDECIDED}.get(str(value))


# Verdicts on a difference beyond chance and margin, and verdicts without such a difference.
DIFFER = (Comparison.WORSE, Comparison.BETTER, Comparison.HIGHER, Comparison.LOWER)
ALIKE = (Comparison.TIE, Comparison.UNDECIDED, Comparison.WITHHELD)


class Claimed(StrEnum):
    """Verdict on whether a claim holds; there is no verdict if the claim is about another recording."""

    CONFIRMED = "confirmed"
    REFUTED = "refuted"
    INCONCLUSIVE = "inconclusive"
    NOT_REPRODUCIBLE = "not reproducible"
    NO_VERDICT = "no verdict"

    @classmethod
    def _missing_(cls, value: object) -> "Claimed | None":
        """Accept the verdicts of older versions in result.json."""
        return cls.INCONCLUSIVE if value == "not shown" else None


@dataclass(frozen=True)
class Squares:
    """Mean of normalised squares: NEES, or NIS per component.

    Attributes:
        name: NEES or NIS.
        found: the mean, with its interval over the runs if there are enough runs.
        aim: the expected value.
        usual: the 95 % interval of a consistent estimator.
    """

    name: str
    found: Interval
    aim: float
    usual: tuple[float, float]

    @property
    def verdict(self) -> Consistency:
        """Return the verdict from the interval over the runs and that of a consistent estimator."""
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
        """Return the ratio of errors to the errors that the estimator claims."""
        return math.sqrt(max(self.found.value, 0.0) / self.aim)

    @property
    def is_far(self) -> bool:
        """Test whether errors exceed the claimed errors by so much that the covariance is unreliable."""
        return self.factor > FAR

    @property
    def has_diverged(self) -> bool:
        """Test whether errors are so large that the estimator has diverged."""
        return self.found.value > DIVERGED * self.aim


def decisive(squares: Sequence[Squares]) -> Squares | None:
    """Return the squares that decide the verdict: the first inconsistent ones, otherwise the first."""
    off = (each for each in squares if each.verdict != Consistency.CONSISTENT)
    return next(off, squares[0] if squares else None)
