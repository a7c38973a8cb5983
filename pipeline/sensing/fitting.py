"""Fits a sensor's noise by maximum likelihood: which terms, how large, how well that is known.

A walk of zero is at the boundary of what may be: with no walk at all its likeliest density is zero in
two of three recordings, so "none found, and it is less than" is an answer.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize, minimize_scalar

from fuselog.pipeline.sensing.likelihood import Likelihood, Samples, likelihood
from fuselog.pipeline.sensing.terms import Terms
from fuselog.replay.engine import chi2

Floats = NDArray[np.float64]
Objective = Callable[[Floats], float]
DROP = 0.5 * float(chi2.ppf(0.95, 1))  # of the log-likelihood, at the ends of a 95 % interval
_FARTHEST = 15.0  # standard deviations, beyond which an end of an interval is not looked for
_SHORTEST = 30  # steps: a Gauss-Markov time below is the sensor's own filter, and no drift


WORDS = {
    "white": "white noise",
    "walk": "a random walk",
    "markov": "Gauss-Markov noise",
    "quantisation": "a quantised angle",
}


class Fit(NamedTuple):
    """Holds the likeliest terms of one kind.

    Attributes:
        free: the names of the terms' numbers.
        terms: the likeliest.
        log_likelihood: with them.
        curvature: (p, p) minus its second derivatives by the logarithms of the numbers.
        size: how many samples it is of.
    """

    free: tuple[str, ...]
    terms: Terms
    log_likelihood: float
    curvature: Floats
    size: int

    @property
    def criterion(self) -> float:
        """Return the log-likelihood less half of BIC's penalty: the greater the better."""
        return self.log_likelihood - 0.5 * len(self.free) * math.log(self.size)

    @property
    def words(self) -> str:
        """Return the names of the terms."""
        return ", ".join(WORDS[name] for name in self.free if name in WORDS)

    @property
    def sigmas(self) -> Floats:
        """Return the standard deviations (p,) of the logarithms of the numbers."""
        return np.sqrt(np.diag(np.linalg.pinv(self.curvature)))


def choose(samples: Samples) -> Fit:
    """Return the fit that BIC prefers: white noise, and what of the other terms there is."""
    white = fit(samples, ())
    walk, markov = fit(samples, ("walk",)), fit(samples, ("markov", "markov_time_s"))
    best = max(white, walk, markov, key=lambda each: each.criterion)
    if best is markov:
        both = fit(samples, ("walk", "markov", "markov_time_s"))
        best = max(best, both, key=lambda each: each.criterion)
    angle = fit(samples, (*best.free[1:], "quantisation"))
    return max(best, angle, key=lambda each: each.criterion)


def fit(samples: Samples, beside_white: Sequence[str]) -> Fit:
    """Maximise the likelihood over white noise and other numbers of the terms.

    All are searched as logarithms, relative to the white noise, which then follows from the residuals;
    Newton's steps end it. A term whose likeliest size is zero stays tiny.
    """
    free = ("white", *beside_white)
    span_s = samples.step_s * float(samples.steps.sum())

    def relative(point: Floats) -> tuple[Terms, Likelihood]:
        terms = Terms(1.0, **dict(zip(beside_white, np.exp(point).tolist(), strict=True)))
        found = likelihood(samples, terms)
        return terms, found

    def cost(point: Floats) -> float:
        if any(not low <= each <= high for each, (low, high) in zip(point, limits, strict=True)):
            return math.inf
        _, found = relative(point)
        size = len(samples.values) - 1
        # the log-likelihood where the white noise is scaled so that the mean square is one
        return -(
            found.log_likelihood + 0.5 * size * (found.mean_square - 1 - math.log(found.mean_square))
        )

    limits = [_limits(name, samples.step_s, span_s) for name in beside_white]
    point = np.zeros(0)
    if beside_white:
        grid = [np.linspace(low, high, 9 if len(limits) < 3 else 6)[:-1] for low, high in limits]
        places = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, len(limits))
        costs = [cost(place) for place in places]
        point = places[int(np.argmin(costs))]
        if len(limits) == 1:
            step = grid[0][1] - grid[0][0]
            near = max(limits[0][0], point[0] - step), min(limits[0][1], point[0] + step)
            one = minimize_scalar(
                lambda x: cost(np.array([x])), bounds=near, method="bounded", options={"xatol": 1e-2}
            )
            point = np.array([one.x])
        else:
            options = {"xatol": 1e-2, "fatol": 1e-3, "maxfev": 400}
            point = minimize(cost, point, method="Nelder-Mead", options=options).x
    terms, found = relative(point)
    scale = math.sqrt(found.mean_square)
    start = np.log([scale, *(_scaled(terms, name, scale) for name in beside_white)])
    objective = _objective(samples, free)
    return _polished(objective, free, start, len(samples.values))


def _limits(name: str, step_s: float, span_s: float) -> tuple[float, float]:
    """Return where the logarithm of a number is searched for, relative to white noise of 1."""
    if name == "markov_time_s":
        return math.log(_SHORTEST * step_s), math.log(max(span_s / 2, 2 * _SHORTEST * step_s))
    if name == "walk":  # from what no recording of that length shows to what one sample shows
        return math.log(0.01 / span_s), math.log(3.0 / step_s)
    if name == "markov":
        return math.log(0.03 / math.sqrt(span_s)), math.log(3.0 / math.sqrt(step_s))
    return math.log(0.01 * math.sqrt(step_s)), math.log(30.0 * math.sqrt(step_s))


def _scaled(terms: Terms, name: str, scale: float) -> float:
    value = float(getattr(terms, name))
    return value if name == "markov_time_s" else value * scale


def _objective(samples: Samples, free: Sequence[str]) -> Objective:
    def log_likelihood(point: Floats) -> float:
        return likelihood(samples, of_point(free, point)).log_likelihood

    return log_likelihood


def of_point(free: Sequence[str], point: Floats) -> Terms:
    """Return the terms whose free numbers have these logarithms.

    Args:
        free: the names of the p numbers, as fields of `Terms`.
        point: (p,), their natural logarithms.

    Returns:
        The terms; all other numbers are as `Terms` has them by default.
    """
    return Terms(**dict(zip(free, np.exp(point).tolist(), strict=True)))


def _polished(objective: Objective, free: tuple[str, ...], point: Floats, size: int) -> Fit:
    """Take Newton's steps, as long as they gain; none where a number is not determined."""
    best = objective(point)
    reach = np.full(len(point), 0.01)
    curvature = np.zeros((len(point), len(point)))
    for _ in range(6):
        gradient, curvature = _derivatives(objective, point, best, reach)
        if np.linalg.eigvalsh(curvature)[0] <= 1e-3:
            break
        sigmas = np.sqrt(np.diag(np.linalg.inv(curvature)))
        reach = np.minimum(0.03 * sigmas, 0.1)
        move = np.linalg.solve(curvature, gradient)
        moved = objective(point + move)
        if not moved > best - 1e-9 * abs(best) or np.max(np.abs(move)) > 2:
            break
        point, best = point + move, moved
        if np.max(np.abs(move) / sigmas) < 3e-5:
            break
    return Fit(free, of_point(free, point), best, curvature, size)


def _derivatives(
    objective: Objective, point: Floats, here: float, reach: Floats
) -> tuple[Floats, Floats]:
    """Compute the gradient and minus the second derivatives by central differences."""
    moves = np.diag(reach)
    ahead, behind = (np.array([objective(point + sign * move) for move in moves]) for sign in (1, -1))
    curvature = np.diag(-(ahead - 2 * here + behind) / reach**2)
    for i in range(len(point)):
        for j in range(i):
            both = objective(point + moves[i] + moves[j]) + objective(point - moves[i] - moves[j])
            mixed = both - ahead[i] - ahead[j] - behind[i] - behind[j] + 2 * here
            curvature[i, j] = curvature[j, i] = -mixed / (2 * reach[i] * reach[j])
    return (ahead - behind) / (2 * reach), curvature


def profile_interval(samples: Samples, found: Fit, name: str) -> tuple[float, float]:
    """Return the 95 % interval of one number of a fit, all others following it.

    An end that no value within reach is at is zero, or infinite.
    """
    place = found.free.index(name)
    others = [i for i in range(len(found.free)) if i != place]
    point = np.log([getattr(found.terms, each) for each in found.free])
    objective = _objective(samples, found.free)
    sigma = float(found.sigmas[place])
    block = found.curvature[np.ix_(others, others)]
    follows = -np.linalg.pinv(block) @ found.curvature[others, place]
    reach = 0.05 * found.sigmas[others]

    def root(distance: float) -> float:
        """Compute the signed root of twice the log-likelihood's loss, less that at an interval's end."""
        at = point.copy()
        at[place] += sign * distance * sigma
        at[others] += follows * sign * distance * sigma
        for _ in range(2 if others else 0):
            slope = np.zeros(len(others))
            for k, other in enumerate(others):
                move = np.zeros(len(at))
                move[other] = reach[k]
                slope[k] = (objective(at + move) - objective(at - move)) / (2 * reach[k])
            at[others] += np.linalg.pinv(block) @ slope
        lost = found.log_likelihood - objective(at)
        return math.sqrt(2 * max(lost, 0.0)) - math.sqrt(2 * DROP)

    ends = []
    for sign in (-1, 1):
        far = 3.0
        while far < _FARTHEST and root(far) < 0:
            far *= 1.5
        if far >= _FARTHEST:
            ends.append(0.0 if sign < 0 else math.inf)
        else:
            distance = brentq(root, 0.5, far, xtol=1e-3) if root(0.5) < 0 else 0.5
            ends.append(math.exp(point[place] + sign * distance * sigma))
    return ends[0], ends[1]


def walk_below(samples: Samples, white: Fit) -> float:
    """Return the walk that a recording in which none was found may have at most, with 95 %."""
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
        (i for i in range(int(np.argmax(values)), len(grid)) if values[i] < top - DROP), len(grid) - 1
    )
    if beyond == 0 or values[beyond] >= top - DROP:
        return math.exp(grid[beyond]) * white.terms.white
    ratio = brentq(lambda each: beside(each)[0] - top + DROP, grid[beyond - 1], grid[beyond], xtol=1e-3)
    return math.exp(ratio) * beside(ratio)[1]
