"""Confidence in tuned parameters: intervals, correlations, profiles, and undetermined directions.

All of these follow from the curvature of minus the log-likelihood at its minimum. The inverse of the
curvature is the parameters' covariance.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.optimise import QUANTILE, Cost
from fuselog.pipeline.tuning.search import UNIT, Coordinates
from fuselog.recorders.parameters import Parameter
from fuselog.replay.engine.arrays import Floats

LEAST_CURVATURE = 4.0  # a standard error of one half: known only within a factor of about 2.7
INVOLVED = 0.3  # component of a unit direction above which a parameter is involved
PROFILE_POINTS = 9
PROFILE_ERRORS = 3.0  # standard errors on either side
MEANINGLESS = 100.0  # a factor so large that the value is unknown
WIDEST = 3.0  # in coordinates: a factor of 20


class Confidence(NamedTuple):
    """The confidence in those m of k parameters that are not at a bound.

    Attributes:
        places: (m,) the indices of the parameters that are not at a bound.
        curvature: (m, m) the second derivatives of the cost in coordinates.
        covariance: (m, m) the inverse of the curvature; variances are infinite in directions in which
            the cost does not rise.
    """

    places: Sequence[int]
    curvature: Floats
    covariance: Floats

    @property
    def errors(self) -> Floats:
        """Return the standard errors (m,) of the coordinates."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlation(self) -> Floats:
        """Return the correlations (m, m); NaN where a variance is infinite."""
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(self.errors, self.errors)


class SearchOutcome(NamedTuple):
    """The end of a search.

    Attributes:
        coordinates: the coordinates that were searched.
        optimum: (k,) the parameter values with the least cost.
        confidence: the confidence in the parameter values; None if the search was not by maximum
            likelihood, was stopped, or ended with all parameters at bounds.
        evaluations: the number of points tried.
        has_converged, was_stopped: how the search ended.
        is_spike: whether a search from a second start does not find this minimum.
        at_edge: parameters for which a run fails or uses fewer measurements near the optimum.
        begins_alike: whether filters begin at the same stamps at the optimum as in the search.
        held: calibration parameters that the motion does not determine, and that keep their start
            values.
        lacks: sentences on the undetermined parameters, and on other values that depend on them.
    """

    coordinates: Coordinates
    optimum: Floats
    evaluations: int
    confidence: Confidence | None = None
    has_converged: bool = True
    was_stopped: bool = False
    is_spike: bool = False
    at_edge: Sequence[str] = ()
    begins_alike: bool = True
    held: Sequence[str] = ()
    lacks: Sequence[str] = ()


def confidence(places: Sequence[int], curvature: Floats) -> Confidence:
    """Compute the covariance of parameters from the curvature of the cost.

    Args:
        places: (m,), the indices of the m parameters among all k.
        curvature: (m, m), the second derivatives of the cost in coordinates.

    Returns:
        The confidence; variances are infinite in directions in which the cost does not rise.
    """
    values, vectors = np.linalg.eigh(curvature)
    rises = values > 0.0
    covariance = (vectors / np.where(rises, values, np.inf)) @ vectors.T
    unknown = np.sum(vectors[:, ~rises] ** 2, axis=1) > INVOLVED**2
    covariance[unknown, unknown] = np.inf
    return Confidence(places, curvature, covariance)


def with_noise(curvature: Floats, noise: Floats) -> Floats:
    """Reduce a curvature so that its inverse is the covariance of the parameters.

    If slopes vary more than the curvature implies, the covariance of the estimates is the slopes'
    covariance, multiplied by the inverse curvature from both sides: White, Maximum likelihood estimation
    of misspecified models, Econometrica 50, 1982. The curvature already contains noise that affects
    slopes linearly, so in each direction the larger of the curvature and the noise is used.

    Args:
        curvature: (m, m), the second derivatives of the cost.
        noise: (m, m), the covariance of the cost's first derivatives caused by the noise of the
            controls.

    Returns:
        The curvature (m, m), reduced in directions in which the noise exceeds it.

    >>> with_noise(np.diag([4.0, 4.0]), np.diag([1.0, 16.0])).round(6).tolist()
    [[4.0, 0.0], [0.0, 1.0]]
    """
    values, vectors = np.linalg.eigh(curvature)
    rises = values > 0.0
    root = vectors[:, rises] * np.sqrt(values[rises])
    inverse = vectors[:, rises] / np.sqrt(values[rises])
    times, along = np.linalg.eigh(inverse.T @ noise @ inverse)
    turned = root @ along
    rest = (vectors[:, ~rises] * values[~rises]) @ vectors[:, ~rises].T
    return (turned / np.maximum(times, 1.0)) @ turned.T + rest


def doubts(confidence: Confidence, coordinates: Coordinates) -> Iterator[str]:
    """Yield a sentence for every direction of the parameters (k,) that the logs determine poorly."""
    own = [coordinates.free[place] for place in confidence.places]
    for direction, value in _weak(confidence, coordinates):
        yield _in_words(direction, value, own)


def unknown(confidence: Confidence, coordinates: Coordinates) -> list[int]:
    """Return the indices of parameters (k,) that the curvature leaves undetermined."""
    found = []
    for direction, value in _weak(confidence, coordinates):
        first, *others = _involved(direction)
        if (
            not others
            and not coordinates.free[confidence.places[first]].useful
            and _factor(value) >= MEANINGLESS
        ):
            found.append(confidence.places[first])
    return found


def _weak(confidence: Confidence, coordinates: Coordinates) -> Iterator[tuple[Floats, float]]:
    """Yield unit directions (m,) in which the cost rises too little, each with its curvature.

    The directions are eigenvectors of the curvature in useful units. The useful unit is a factor of 2.7
    for a positive parameter, and two useful standard errors for any other; for a parameter without a
    useful error, it is `UNIT` standard errors with all others fixed.
    """
    places = list(confidence.places)
    own, units = [coordinates.free[place] for place in places], coordinates.units[places]
    is_log = np.array([each.is_log for each in own])
    useful = np.array([each.useful for each in own])
    diagonal = np.diagonal(confidence.curvature)
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.where(diagonal <= 0.0, 1.0, UNIT / np.sqrt(diagonal))
    scale = np.select([is_log, useful > 0.0], [1.0, 2.0 * useful / units], alone)
    values, vectors = np.linalg.eigh(confidence.curvature * np.outer(scale, scale))
    for index in np.flatnonzero(values < LEAST_CURVATURE):
        yield vectors[:, index], values[index]


def _involved(direction: Floats) -> list[int]:
    """Return the indices of the relevant components of a direction (m,), the largest first."""
    order = np.argsort(-np.abs(direction)).tolist()
    return [place for place in order if abs(direction[place]) > INVOLVED]


def _factor(value: float) -> float:
    """Compute the factor within which a positive parameter with this curvature is known."""
    return float(np.exp(min(QUANTILE / np.sqrt(max(value, 1e-12)), 700.0)))


def _in_words(direction: Floats, value: float, free: Sequence[Parameter]) -> str:
    """Describe the effect of a small curvature along a unit direction (m,)."""
    names = [each.name for each in free]
    first, *others = _involved(direction)
    if not others and free[first].useful:
        return f"{names[first]}: the logs determine it less accurately than is useful"
    if not others and _factor(value) < MEANINGLESS:
        return f"{names[first]}: the logs determine it within a factor of {_factor(value):.2g} (95 %)"
    if not others:
        return (
            f"{names[first]}: the logs do not determine it; they only show that the start value, "
            f"{free[first].default:g}, fits less well"
        )
    turned = [
        f"a {'larger' if direction[place] * direction[first] > 0.0 else 'smaller'} {names[place]}"
        for place in others
    ]
    return (
        f"{', '.join(names[place] for place in (first, *others))}: the logs hardly distinguish "
        f"these parameters; a larger {names[first]} with {' and '.join(turned)} fits almost as well"
    )


class Profile(NamedTuple):
    """The cost along one parameter, with all others optimised to second order.

    Attributes:
        name: the name of the parameter.
        along: (n,) its values.
        rise: (n,) the cost relative to the minimum; infinite if it cannot be computed.
        parabola: (n,) the relative cost, computed from the curvature only.
    """

    name: str
    along: Floats
    rise: Floats
    parabola: Floats


def profiles(
    cost: Cost, coordinates: Coordinates, point: Floats, confidence: Confidence
) -> list[Profile]:
    """Compute the profiles of all parameters that have a standard error.

    Args:
        cost: function that computes minus the log-likelihoods of values (n, k).
        coordinates: the coordinates that were searched.
        point: (k,), the coordinates of the least cost.
        confidence: the confidence at that point.

    Returns:
        A profile for each such parameter, over `PROFILE_POINTS` values.
    """
    found = []
    for index, place in enumerate(confidence.places):
        error, free = confidence.errors[index], coordinates.free[place]
        if not np.isfinite(error):
            continue
        reach = min(PROFILE_ERRORS * error, WIDEST if free.is_log else np.inf)
        way = np.linspace(-reach, reach, PROFILE_POINTS)
        points = np.tile(point, (PROFILE_POINTS, 1))
        points[:, list(confidence.places)] += np.outer(way, confidence.covariance[:, index] / error**2)
        values = coordinates.values(points)
        costs = cost(values)
        rise = costs - costs[PROFILE_POINTS // 2]
        found.append(Profile(free.name, values[:, place], rise, 0.5 * (way / error) ** 2))
    return found
