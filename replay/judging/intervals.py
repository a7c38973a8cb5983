"""95 % intervals of means and root mean squares, by the rules in docs/judge.md.

The unit of these statistics is the run: errors within a run are correlated, and runs are independent. A
mean has Student's t interval. A root mean square has a percentile bootstrap interval over runs, widened
for few runs like Student's t interval: Hesterberg, "What Teachers Should Know About the Bootstrap", The
American Statistician 69 (2015).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
# With fewer runs, there is no information about other runs.
FEWEST_RUNS = 5
RESAMPLES = 2000
# Over more runs, the mean square is normal; resampling would only need more memory.
MANY_RUNS = 500
LARGE = 1e100  # sums of squares of larger numbers may be infinite


class Interval(NamedTuple):
    """Number and its 95 % interval.

    Attributes:
        value: the number.
        low, high: the ends of the interval; NaN if there is no interval, and equal to the number if the
            number is exact.
        unit: unit of the number and both ends; may be empty.
        name: name of the number, if it is not clear from its context.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str = ""
    name: str = ""

    def __str__(self) -> str:
        with_unit = f"{self.value:.3g} {self.unit}".rstrip()
        return f"{with_unit} (95 % {self.low:.3g} to {self.high:.3g})" if self.is_known else with_unit

    @property
    def is_known(self) -> bool:
        """Test whether neither the value nor an end is NaN."""
        return not any(map(math.isnan, self[:3]))

    @property
    def is_bounded(self) -> bool:
        """Test whether both ends are finite."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def rising(self, function: Callable[[float], float]) -> "Interval":
        """Apply an increasing function, such as `math.exp` for an interval of a logarithm.

        Args:
            function: function of a number.

        Returns:
            The interval with the function applied to its value and ends.
        """
        return self._replace(
            value=function(self.value), low=function(self.low), high=function(self.high)
        )


def too_few(runs: int) -> str:
    """Return the reason why there is no interval over this number of runs."""
    there = "is only 1" if runs == 1 else f"are only {runs}"
    return f"an interval needs at least {FEWEST_RUNS} runs, and there {there}"


def mean_interval(values: ArrayLike, fewest: int = FEWEST_RUNS) -> Interval:
    """Compute the mean of runs (n,) and its interval by Student's t distribution.

    Args:
        values: one value per run.
        fewest: smallest number of runs for an interval. Only a study with a fixed number of units, such
            as the robots in a recording, sets a number other than the default.
    """
    from scipy.special import stdtrit

    values, scale = _with_finite_squares(np.asarray(values, float))
    runs = len(values)
    mean = scale * float(values.mean()) if runs else math.nan
    if runs < fewest:
        return Interval(mean)
    half = float(stdtrit(runs - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(runs))
    return Interval(mean, scale * (float(values.mean()) - half), scale * (float(values.mean()) + half))


def rms_interval(values: ArrayLike) -> Interval:
    """Compute the root mean square of runs (n,) and its interval by bootstrap."""
    from scipy.special import ndtr, stdtrit

    value = root_mean_square(values)
    values, scale = _with_finite_squares(np.asarray(values, float))
    runs = len(values)
    if runs < FEWEST_RUNS:
        return Interval(value)
    squares = values**2
    if runs > MANY_RUNS:
        _, low, high, *_ = mean_interval(squares)
        return Interval(value, scale * math.sqrt(max(low, 0.0)), scale * math.sqrt(high))
    drawn = np.random.default_rng(0).integers(0, runs, (RESAMPLES, runs))
    tail = 1.0 - ndtr(np.sqrt(runs / (runs - 1)) * stdtrit(runs - 1, 0.975))
    low, high = np.sqrt(np.quantile(squares[drawn].mean(axis=1), [tail, 1.0 - tail]))
    return Interval(value, scale * float(low), scale * float(high))


def root_mean_square(values: ArrayLike) -> float:
    """Compute the root mean square of values (n,), even if their squares overflow."""
    values, scale = _with_finite_squares(np.asarray(values, float))
    return scale * math.sqrt(np.mean(np.square(values))) if len(values) else math.nan


def _with_finite_squares(values: Floats) -> tuple[Floats, float]:
    """Scale numbers (n,) so that their squares are finite; also return the scale, which is usually 1."""
    largest = float(np.max(np.abs(values), initial=0.0))
    scale = largest if LARGE < largest < math.inf else 1.0
    return values / scale, scale
