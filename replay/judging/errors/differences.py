"""Paired differences of a metric between two estimators over the same runs.

Intervals are percentile bootstrap intervals, see `fuselog.replay.judging.intervals`. BCa intervals are
not better: paired differences of two equal estimators are symmetric even if the metric is skewed, so BCa
corrects only random effects (over 50 runs, it classified 9 to 11 % of equal NEES as different). Each
metric has its own 95 % interval: among many metrics without a difference, about one in twenty is
classified as different by chance.
"""

import math
from collections.abc import Callable
from fnmatch import fnmatch
from typing import Any, Literal, NamedTuple

import numpy as np

from fuselog.replay.judging.intervals import FEWEST_RUNS, RESAMPLES, Floats, Interval
from fuselog.replay.judging.verdicts import Comparison

# Target of a metric: small, large, or near a value; None if no direction is better.
Target = Literal["low", "high"] | float | None
# Maximum number of resampled values in memory at a time.
BATCH_NUMBERS = 1 << 22
# A log-likelihood has no natural zero, so a margin of 0.02 means 2 nats.
NATS = 100.0
TARGETS: dict[str, Target] = {
    "*rmse*": "low",
    "ape_*": "low",
    "rpe_*": "low",
    "*gospa*": "low",
    "*ospa*": "low",
    "cost": "low",
    "failed_runs": "low",
    "skipped_measurements": "low",
    "estimate_age_s": "low",
    "localisation_m2": "low",
    "missed_targets": "low",
    "false_targets": "low",
    "switches": "low",
    "breaks": "low",
    "followed_share": "high",
    "*hota": "high",
    "*idf1": "high",
    "estimates_without_*": "low",
    "log_likelihood": "high",
    "estimated_share": "high",
    "converged_share": "high",
    "effective_share": "high",
    "kept_*_percent": "high",
    "own_track_mean_percent": "high",
    "nis_per_component": 1.0,
    "nees_steps_within_95": 0.95,
}


FEWEST_DOMINATED = 3  # smallest number of values for which one can dominate


def dominating(values: Floats) -> int | None:
    """Return the index of the value that exceeds the sum of all others; the values (n,) are >= 0.

    The result is None if there is no such value, or if there are too few values.
    """
    if len(values) < FEWEST_DOMINATED:
        return None
    greatest = int(np.argmax(values))
    return greatest if 2.0 * values[greatest] > values.sum() else None


class Difference(NamedTuple):
    """Difference of a metric between two estimators over the same runs.

    Attributes:
        first, second: the means over the runs.
        more: second - first.
        margin: differences up to this value are unimportant.
        verdict: verdict on the second estimator, which depends on whether the interval is beyond the
            margin or within it.
        sure: fraction of the resamples in which the difference has the sign of `more`.
        runs: number of runs.
    """

    first: float
    second: float
    more: Interval
    margin: float
    verdict: Comparison
    sure: float
    runs: int

    @property
    def columns(self) -> dict[str, Any]:
        """Return the values by column name, for tables."""
        about = {"margin": self.margin, "verdict": str(self.verdict), "sure": self.sure}
        ends = {"difference": self.more.value, "low": self.more.low, "high": self.more.high}
        return {"first_mean": self.first, "second_mean": self.second, **ends, **about, "runs": self.runs}


def target_of(quantity: str) -> Target:
    """Return the target of a registered metric; None if it has no target."""
    return next((target for pattern, target in TARGETS.items() if fnmatch(quantity, pattern)), None)


def paired_difference(
    first: Floats, second: Floats, target: Target, margin: float, scale: float | None = None
) -> Difference:
    """Compute the second estimator's metric minus the first estimator's, with interval and verdict.

    Args:
        first: (n,) the metric in every run.
        second: (n,) the metric in the same runs.
        target: target of the metric.
        margin: unimportant difference, as a fraction of the first estimator's mean or of the target
            value.
        scale: value that replaces the first estimator's mean or the target value.
    """
    means = float(first.mean()), float(second.mean())
    if scale is None:
        scale = target if isinstance(target, float) else abs(means[0])
    difference, runs, allowed = means[1] - means[0], len(first), margin * scale
    more, sure = Interval(difference), math.nan
    verdict = Comparison.UNDECIDED
    if np.array_equal(first, second):
        more = Interval(0.0, 0.0, 0.0) if runs >= FEWEST_RUNS else Interval(0.0)
        sure, verdict = 1.0, Comparison.TIE
    elif runs >= FEWEST_RUNS:
        low, high, resamples = _interval(first, second, _difference)
        more = Interval(difference, low, high)
        sure = float(np.mean(np.sign(resamples) == np.sign(difference)))
        if -allowed <= low and high <= allowed:
            verdict = Comparison.TIE
        elif low > allowed or high < -allowed:
            verdict = _direction(first, second, target, difference)
    return Difference(*means, more, allowed, verdict, sure, runs)


def _difference(first: Floats, second: Floats) -> Floats:
    mean: Floats = second.mean(-1) - first.mean(-1)
    return mean


def _interval(
    first: Floats, second: Floats, statistic: Callable[[Floats, Floats], Floats]
) -> tuple[float, float, Floats]:
    """Compute the 95 % bootstrap interval of a statistic of the pairs, and its resamples.

    The result is that of `scipy.stats.bootstrap`, which is slow to import.
    """
    from scipy.special import ndtr, stdtrit  # slow to import

    runs, rng = len(first), np.random.default_rng(0)
    widened = np.sqrt(runs / (runs - 1)) * stdtrit(runs - 1, 0.975)
    batch, parts = max(BATCH_NUMBERS // runs, 1), list[Floats]()
    for begin in range(0, RESAMPLES, batch):
        chosen = rng.integers(0, runs, (min(batch, RESAMPLES - begin), runs))
        parts.append(statistic(first[chosen], second[chosen]))
    resamples = np.concatenate(parts)
    if np.isnan(resamples).any():
        return math.nan, math.nan, resamples
    shares = np.array([1.0 - ndtr(widened), ndtr(widened)])
    place = shares * RESAMPLES + (1.0 - shares)  # of the ends in the sorted resamples, from 1
    ordered, before, beyond = np.sort(resamples), place.astype(np.int64) - 1, place % 1.0
    low, high = (1.0 - beyond) * ordered[before] + beyond * ordered[before + 1]
    return float(low), float(high), resamples


def _direction(first: Floats, second: Floats, target: Target, difference: float) -> Comparison:
    """Return the verdict on a difference; if neither is closer to the target, it is higher or lower."""
    if target in ("low", "high"):
        return Comparison.WORSE if (difference > 0) == (target == "low") else Comparison.BETTER
    if isinstance(target, float):

        def farther(first: Floats, second: Floats) -> Floats:
            distance: Floats = np.abs(second.mean(-1) - target) - np.abs(first.mean(-1) - target)
            return distance

        low, high, _ = _interval(first, second, farther)
        if low > 0 or high < 0:
            return Comparison.WORSE if low > 0 else Comparison.BETTER
    return Comparison.HIGHER if difference > 0 else Comparison.LOWER
