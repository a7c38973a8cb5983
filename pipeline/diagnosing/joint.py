"""A joint fit of the sizes of several faults, with the search that `tune` and `calibrate` use.

Each fault hides parts of the others. If the sizes were estimated one after the other, each size and
interval would refer to a log that still contains other faults.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, Number
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.diagnosing.search import WIDE, Peak
from fuselog.pipeline.optimise import curvature, profile_ends, rises
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.confidence import confidence
from fuselog.pipeline.tuning.search import (
    CURVATURE_STEP,
    LEAST_GAIN,
    UNIT,
    Coordinates,
    coordinates_of,
    least,
)
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameter

Floats = NDArray[np.float64]
# relative to a value: offsets to detect a jump, and to begin a search away from it
TINY, OFF = 1e-6, 2e-3
NEAR = 1e-3  # relative to a value or its limit: offset for tests of no effect and of limits
TOLERANCE = 1e-7  # log-likelihood: far less than anything significant


class Supposed(NamedTuple):
    """A fault with its assumed value."""

    of: Hypothesis
    value: Number

    def without(self, trial: Trial) -> Trial:
        """Correct the fault in a trial."""
        return self.of.without(trial, self.value)

    @property
    def is_special(self) -> bool:
        """Test whether the value is among the values that are tried exactly."""
        return self.value in self.of.specials

    @property
    def numbers(self) -> list[float]:
        """Return the values to search for; a fault without a value has none."""
        if not self.of.tried:
            return []
        return list(self.value) if self.of.size > 1 else [self.value]

    def number(self, numbers: Sequence[float]) -> Number:
        """Convert a vector's entries to the fault's value; keep that value if there are no entries."""
        if not self.of.tried:
            return self.value
        return tuple(map(float, numbers)) if self.of.size > 1 else float(numbers[0])


def corrected(base: Trial, faults: Sequence[Supposed]) -> Trial:
    """Correct all faults in a trial."""
    return reduce(lambda trial, each: each.without(trial), faults, base)


class Fit(NamedTuple):
    """The values with which several faults together explain a log best.

    Attributes:
        faults: the faults with the values that explain the log best.
        log_likelihood: log-likelihood of the log with the faults corrected.
        losses: loss of log-likelihood, approximated from the curvature, if a fault is removed and all
            others are refitted; infinite for a fault without a value.
        are_estimates: whether the values of a fault are estimates; they are not if the search ended at
            their limit, or if they have no effect.
        ends: ends of the 95 % profile-likelihood intervals of each fault's values; NaN if the search
            did not converge.
    """

    faults: Sequence[Supposed]
    log_likelihood: float
    losses: Sequence[float]
    are_estimates: Sequence[bool]
    ends: Sequence[tuple[Number, Number]] = ()


def fit(
    likelihood: Likelihood, base: Trial, faults: Sequence[Supposed], *, has_ends: bool = False
) -> Fit:
    """Search for the values of several faults together, starting from their present values.

    Args:
        likelihood: function that computes the log-likelihoods of trials.
        base: the unaltered log, and the settings.
        faults: faults with start values.
        has_ends: whether the ends of intervals are computed.
    """
    together = _Together(likelihood, base, faults)
    unknown = [(value, value) for value in together.values(np.full(len(together.start), np.nan))]
    start = together.beside_jumps()
    try:
        coordinates = coordinates_of(together.cost, together.free, start)
        begin = coordinates.of(start)
        point, has_converged = least(
            together.cost, coordinates, begin, is_smooth=True, tolerance=TOLERANCE
        )
    except BadInput:  # one of the values has no effect
        [found] = likelihood([corrected(base, faults)])
        is_free = ~(together.is_flat(start) | together.at_limits(start))
        are_estimates = [bool(is_free[own].all()) for own in together.places]
        return Fit(faults, found, [np.inf] * len(faults), are_estimates, unknown)
    cost_at = coordinates.over(together.cost)
    around, bent = curvature(cost_at, point, range(len(point)), 1.0 / UNIT)
    is_top = rises(around, bent)
    losses, ends, at_bounds = [np.inf] * len(faults), unknown, coordinates.at_bounds(point)
    if has_converged and is_top and not at_bounds.any():
        covariance = confidence(range(len(point)), bent).covariance
        losses = [_loss(point[own], covariance[np.ix_(own, own)]) for own in together.places]
        if has_ends:
            low, high = map(coordinates.unbounded, profile_ends(cost_at, point, bent))
            ends = list(zip(together.values(low), together.values(high), strict=True))
            point = _at_specials(together, coordinates, point, covariance, (low, high))
    numbers = coordinates.values(point)
    [cost] = together.cost(numbers[None])
    values = together.values(numbers)
    fitted = [each._replace(value=value) for each, value in zip(faults, values, strict=True)]
    are_estimates = [not bool(at_bounds[own].any()) for own in together.places]
    return Fit(fitted, -float(cost), losses, are_estimates, ends)


def promised(likelihood: Likelihood, base: Trial, faults: Sequence[tuple[Peak, Hypothesis]]) -> float:
    """Estimate, from the curvature, the gain of the last of several faults if all are fitted again.

    The estimate is a generous upper bound: the fault's gain in addition to the others, plus WIDE times
    the gain of the next step of a search. The estimate is infinite if the log-likelihood is not concave.
    """
    together = _Together(likelihood, base, [Supposed(of, at.value) for at, of in faults])
    steps = np.concatenate([np.empty(0), *(_errors(at, of) for at, of in faults)])
    coordinates = Coordinates(together.free, steps / CURVATURE_STEP)
    point = coordinates.of(together.start)
    cost_at = coordinates.over(together.cost)
    around, bent = curvature(cost_at, point, range(len(point)), CURVATURE_STEP)
    if not rises(around, bent):
        return np.inf
    down = np.linalg.solve(bent, around.slopes)
    return faults[-1][0].gain + 0.5 * WIDE * float(around.slopes @ down)


def _errors(at: Peak, of: Hypothesis) -> Floats:
    """Approximate the standard errors of the values (m,) of a fault at its largest gain."""
    if not of.tried or of.size > 1:
        return np.array(of.tried[0] if of.tried else (), float)
    return np.array([abs(at.value) / (2.0 * max(at.gain, 1.0)) ** 0.5])


class _Together:
    """The values of all faults as one vector (k,)."""

    def __init__(self, likelihood: Likelihood, base: Trial, faults: Sequence[Supposed]) -> None:
        self.likelihood, self.base, self.faults = likelihood, base, faults
        self.known: dict[bytes, float] = {}
        self.start = np.array([number for each in faults for number in each.numbers])
        places = iter(range(len(self.start)))
        self.places = [[next(places) for _ in each.numbers] for each in faults]
        limits = [each.of.limit if each.of.has_end else np.inf for each in faults]
        self.free = [
            Parameter(each.of.name, number, low=-limit, high=limit)
            for each, limit in zip(faults, limits, strict=True)
            for number in each.numbers
        ]

    def values(self, numbers: Floats) -> list[Number]:
        """Convert the vector (k,) to the values of the faults."""
        return [
            each.number(numbers[own].tolist())
            for each, own in zip(self.faults, self.places, strict=True)
        ]

    def cost(self, points: Floats) -> Floats:
        """Compute negative log-likelihoods (n,) of the log with faults of values (n, k) corrected.

        The parts of a fit ask for some points again, so known values are kept.
        """
        new = {key: point for point in points if (key := point.tobytes()) not in self.known}
        of_points = [
            [Supposed(each.of, at) for each, at in zip(self.faults, self.values(point), strict=True)]
            for point in new.values()
        ]
        found = self.likelihood([corrected(self.base, faults) for faults in of_points]) if new else []
        self.known.update(zip(new, found, strict=True))
        return -np.array([self.known[point.tobytes()] for point in points])

    def is_flat(self, point: Floats) -> NDArray[np.bool_]:
        """Test which values (k,) have no effect near a point (k,)."""
        apart = np.diag(np.maximum(np.abs(point), 1.0) * NEAR)
        here, *costs = self.cost(np.concatenate([point[None], point + apart, point - apart]))
        return np.all(np.reshape(costs, (2, -1)) == here, axis=0)

    def at_limits(self, point: Floats) -> NDArray[np.bool_]:
        """Test which values (k,) of a point (k,) are at the limit of the search."""
        limits = np.array([each.high for each in self.free])
        return np.abs(point) >= (1.0 - NEAR) * limits

    def beside_jumps(self) -> Floats:
        """Return the start (k,) of a search, moved slightly if the log-likelihood jumps there.

        A delay moves the first or the last message out of the log; slopes across such a jump have no
        meaning.
        """
        start = self.start.copy()
        apart = np.diag(TINY * start)
        here, *costs = self.cost(np.concatenate([start[None], start + apart, start - apart]))
        above, below = np.split(np.array(costs), 2)
        jumps = np.maximum(np.abs(above - here), np.abs(below - here)) > LEAST_GAIN
        way = np.where(above < below, 1.0, -1.0) * np.sign(start)
        start[jumps] += (OFF * way * np.maximum(np.abs(start), 1.0))[jumps]
        return start


def _loss(own: Floats, covariance: Floats) -> float:
    """Compute the loss of log-likelihood if values (m,) with a covariance (m, m) are set to zero."""
    return 0.5 * float(own @ np.linalg.solve(covariance, own)) if len(own) else np.inf


def _at_specials(
    together: _Together,
    coordinates: Coordinates,
    point: Floats,
    covariance: Floats,
    ends: tuple[Floats, Floats],
) -> Floats:
    """Adopt special values, such as the factor of a unit, that are within the intervals."""
    specials = dict[int, float]()
    for own, each in zip(together.places, together.faults, strict=True):
        for place in own[: each.of.size == 1]:
            low, high = (every[place] for every in ends)
            within = [at / coordinates.units[place] for at in each.of.specials if low < at < high]
            specials.update((place, at) for at in within[:1])
    places = list(specials)
    apart = np.array([*specials.values()]) - point[places]
    return point + covariance[:, places] @ np.linalg.solve(covariance[np.ix_(places, places)], apart)
