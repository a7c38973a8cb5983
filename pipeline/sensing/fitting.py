"""A maximum-likelihood fit of a sensor's noise: its terms with sizes and intervals.

A random walk of zero is at the boundary of the possible values. If a sensor has no walk, the most likely
density of the walk is zero in two of three recordings. Therefore the result may be that no walk is
found, with an upper limit.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from fuselog.pipeline.optimise import DROP_95, Cost, curvature, minimum, profile_ends
from fuselog.pipeline.sensing.likelihood import Likelihood, Samples, likelihood
from fuselog.pipeline.sensing.terms import Terms
from fuselog.replay.engine.arrays import Floats

_GAIN = 1e-7  # smallest gain of a step in log-likelihood
# accuracy of interval ends, and doublings of the distance: up to 16 standard deviations
_WITHIN, _DOUBLINGS = 1e-4, 4
_SHORTEST = 30  # number of steps: a shorter Gauss-Markov time is the sensor's own filter, not a drift


WORDS = {
    "white": "white noise",
    "walk": "a random walk",
    "markov": "Gauss-Markov noise",
    "quantisation": "a quantised angle",
}


class Fit(NamedTuple):
    """The most likely terms of one kind.

    Attributes:
        free: the names of the parameters of the terms.
        terms: the most likely terms.
        log_likelihood: the log-likelihood with these terms.
        curvature: (p, p) minus the second derivatives of the log-likelihood with respect to the
            logarithms of the parameters.
        size: the number of samples.
    """

    free: tuple[str, ...]
    terms: Terms
    log_likelihood: float
    curvature: Floats
    size: int

    @property
    def criterion(self) -> float:
        """Return the log-likelihood minus half of the penalty in BIC; larger is better."""
        return self.log_likelihood - 0.5 * len(self.free) * math.log(self.size)

    @property
    def words(self) -> str:
        """Return the names of the terms in words."""
        return ", ".join(WORDS[name] for name in self.free if name in WORDS)

    @property
    def sigmas(self) -> Floats:
        """Return the standard deviations (p,) of the logarithms of the parameters."""
        return np.sqrt(np.diag(np.linalg.pinv(self.curvature)))


def choose(samples: Samples) -> Fit:
    """Choose the fit with the best BIC: white noise, and those other terms that improve the BIC."""
    white = fit(samples, ())
    walk, markov = fit(samples, ("walk",)), fit(samples, ("markov", "markov_time_s"))
    best = max(white, walk, markov, key=lambda each: each.criterion)
    if best is markov:
        both = fit(samples, ("walk", "markov", "markov_time_s"))
        best = max(best, both, key=lambda each: each.criterion)
    angle = fit(samples, (*best.free[1:], "quantisation"))
    return max(best, angle, key=lambda each: each.criterion)


def fit(samples: Samples, beside_white: Sequence[str]) -> Fit:
    """Maximise the likelihood over white noise and the other parameters of the terms.

    All parameters are searched as logarithms relative to the white noise, which then follows from the
    residuals. Newton steps complete the search. A term whose most likely size is zero stays tiny.
    """
    free = ("white", *beside_white)
    span_s = samples.step_s * float(samples.steps.sum())

    def relative(point: Floats) -> tuple[Terms, Likelihood]:
        terms = Terms(1.0, **dict(zip(beside_white, np.exp(point).tolist(), strict=True)))
        return terms, likelihood(samples, terms)

    def cost(points: Floats) -> Floats:
        """Compute minus the log-likelihoods with white noise scaled to a mean square of one."""
        squares, size = [], len(samples.values) - 1
        for point in points:
            _, found = relative(point)
            gained = 0.5 * size * (found.mean_square - 1 - math.log(found.mean_square))
            squares.append(-found.log_likelihood - gained)
        return np.array(squares)

    limits = np.array([_limits(name, samples.step_s, span_s) for name in beside_white]).reshape(-1, 2)
    point = np.zeros(0)
    if beside_white:
        grid = [np.linspace(low, high, 9 if len(limits) < 3 else 6)[:-1] for low, high in limits]
        places = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, len(limits))
        start = places[int(np.argmin(cost(places)))]
        point, _ = minimum(cost, start, (limits[:, 0], limits[:, 1]), tolerance=_GAIN)
    terms, found = relative(point)
    scale = math.sqrt(found.mean_square)
    start = np.log([scale, *(_scaled(terms, name, scale) for name in beside_white)])
    return _polished(_cost(samples, free), free, start, len(samples.values))


def _limits(name: str, step_s: float, span_s: float) -> tuple[float, float]:
    """Return the search range of the logarithm of a parameter, relative to white noise of 1."""
    if name == "markov_time_s":
        return math.log(_SHORTEST * step_s), math.log(max(span_s / 2, 2 * _SHORTEST * step_s))
    # from a size that is invisible in a recording of that length to one that a single sample shows
    if name == "walk":
        return math.log(0.01 / span_s), math.log(3.0 / step_s)
    if name == "markov":
        return math.log(0.03 / math.sqrt(span_s)), math.log(3.0 / math.sqrt(step_s))
    return math.log(0.01 * math.sqrt(step_s)), math.log(30.0 * math.sqrt(step_s))


def _scaled(terms: Terms, name: str, scale: float) -> float:
    value = float(getattr(terms, name))
    return value if name == "markov_time_s" else value * scale


def _cost(samples: Samples, free: Sequence[str]) -> Cost:
    """Make a function that maps logarithms (n, p) of parameters to minus the log-likelihoods (n,)."""
    return lambda points: np.array(
        [-likelihood(samples, of_point(free, each)).log_likelihood for each in points]
    )


def of_point(free: Sequence[str], point: Floats) -> Terms:
    """Make the terms whose free parameters have these logarithms.

    Args:
        free: the names of the p parameters, as fields of `Terms`.
        point: (p,), natural logarithms of the parameters.

    Returns:
        The terms; all other parameters have the defaults of `Terms`.
    """
    return Terms(**dict(zip(free, np.exp(point).tolist(), strict=True)))


def _polished(cost: Cost, free: tuple[str, ...], point: Floats, size: int) -> Fit:
    """Take Newton steps while they improve the fit; take none if a parameter is not determined."""
    [best] = cost(point[None])
    reach = np.full(len(point), 0.01)
    bent = np.zeros((len(point), len(point)))
    for _ in range(6):
        around, bent = curvature(cost, point, range(len(point)), reach)
        if np.linalg.eigvalsh(bent)[0] <= 1e-3:
            break
        sigmas = np.sqrt(np.diag(np.linalg.inv(bent)))
        reach = np.minimum(0.03 * sigmas, 0.1)
        move = -np.linalg.solve(bent, around.slopes)
        [moved] = cost((point + move)[None])
        if not moved < best + 1e-9 * abs(best) or np.max(np.abs(move)) > 2:
            break
        point, best = point + move, moved
        if np.max(np.abs(move) / sigmas) < 3e-5:
            break
    return Fit(free, of_point(free, point), -float(best), bent, size)


def intervals(samples: Samples, found: Fit) -> dict[str, tuple[float, float]]:
    """Compute the 95 % profile-likelihood intervals of a fit's parameters, by name.

    An end that the search does not reach is set to zero or infinity.
    """
    point = np.log([getattr(found.terms, each) for each in found.free])
    ends = profile_ends(
        _cost(samples, found.free),
        point,
        found.curvature,
        corrections=2,
        within=_WITHIN,
        doublings=_DOUBLINGS,
    )
    low, high = np.exp(ends).tolist()
    return dict(zip(found.free, zip(low, high, strict=True), strict=True))


def walk_below(samples: Samples, white: Fit) -> float:
    """Compute the 95 % upper limit of the walk in a recording in which no walk was found."""
    size = len(samples.values) - 1

    def beside(log_ratio: float) -> tuple[float, float]:
        found = likelihood(samples, Terms(1.0, math.exp(log_ratio)))
        gained = 0.5 * size * (found.mean_square - 1 - math.log(found.mean_square))
        return found.log_likelihood + gained, math.sqrt(found.mean_square)

    low, high = _limits("walk", samples.step_s, samples.step_s * float(samples.steps.sum()))
    grid = np.linspace(low, high, 40)
    values = [beside(each)[0] for each in grid]
    top = max(*values, white.log_likelihood)
    beyond = next(
        (i for i in range(int(np.argmax(values)), len(grid)) if values[i] < top - DROP_95), len(grid) - 1
    )
    if beyond == 0 or values[beyond] >= top - DROP_95:
        return math.exp(grid[beyond]) * white.terms.white
    ratio = brentq(
        lambda each: beside(each)[0] - top + DROP_95, grid[beyond - 1], grid[beyond], xtol=1e-3
    )
    return math.exp(ratio) * beside(ratio)[1]
