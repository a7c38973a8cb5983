"""Finds where a cost is least, how it bends there, and where 95 % of a likelihood end.

A cost takes points together, so that whoever computes it may share them out; minus a log-likelihood is
one. Begin with `minimum`; `Beside` has differences about a point, `profile_ends` an interval by them.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from itertools import combinations, product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri

Floats = NDArray[np.float64]
# Points (n, k) -> what each costs (n,); infinity where it cannot be used.
Cost = Callable[[Floats], Floats]
# A search yields what it asks for, is sent what that gains, and returns what it found.
Asked = TypeVar("Asked")
Found = TypeVar("Found")
Search = Generator[Sequence[Asked], Sequence[float], Found]

QUANTILE = float(ndtri(0.975))
DROP_95 = 0.5 * QUANTILE**2  # of the log-likelihood, from its greatest to where 95 % of a number end
ROOT_95 = DROP_95**0.5
STEP = 1e-4  # of the differences for a gradient
ITERATIONS = 200
TOLERANCE = 1e-13  # of a cost: what a step has to gain
FIRST_SIMPLEX = 0.7  # the sides of the first one
END = 1e-3  # of how far an end is: what it need not be known better by
SHARES = 0.05, 0.95  # of a bracket, between which its next value is
DOUBLINGS = 12  # of the way to an end
NARROWINGS = 40  # of the bracket of an end at most
LARGEST = 1e12  # a loss, of what cannot be used


def minimum(
    cost: Cost,
    start: Floats,
    bounds: tuple[Floats, Floats],
    *,
    is_smooth: bool = True,
    tolerance: float = TOLERANCE,
) -> tuple[Floats, bool]:
    """Find the minimum that a cost falls to from a start, by L-BFGS-B, or by a simplex if it is rough.

    Args:
        cost: of points (n, k).
        start: (k,).
        bounds: (k,), (k,).
        is_smooth: whether the cost has a gradient, so that the search may follow it.
        tolerance: the share of a smooth cost that a step has to gain for the search to go on.

    Returns:
        The minimum (k,), and whether the search converged.
    """
    low, high = bounds
    # what cannot be used is a wall that a search turns back from
    at_start = float(cost(start[None])[0])
    wall = (10.0 * abs(at_start) if np.isfinite(at_start) else 0.0) + 1e6

    def with_gradient(point: Floats) -> tuple[float, Floats]:
        """Return the cost and its slopes; none towards a side that cannot be used, as at a bound."""
        steps = STEP * np.eye(len(point))
        points = np.clip(np.concatenate([point[None], point + steps, point - steps]), low, high)
        here, ahead, behind = np.split(np.fmin(cost(points), wall), [1, 1 + len(point)])
        above, below = np.split(points[1:], 2)
        is_ahead, is_behind = ahead < wall, behind < wall
        rise = np.where(is_ahead, ahead, here) - np.where(is_behind, behind, here)
        ends = np.where(is_ahead, above.diagonal(), point) - np.where(is_behind, below.diagonal(), point)
        slopes = np.divide(rise, ends, np.zeros_like(rise), where=ends > 0.0)
        is_blocked = np.where(slopes < 0.0, ~is_ahead, ~is_behind)
        return float(here[0]), np.where(is_blocked, 0.0, slopes)

    of_bounds = list(zip(low, high, strict=True))
    if is_smooth:
        options: dict[str, Any] = {"maxiter": ITERATIONS, "ftol": tolerance, "gtol": 1e-5}
        found = minimize(
            with_gradient, start, jac=True, method="L-BFGS-B", bounds=of_bounds, options=options
        )
        return found.x, bool(found.nit < ITERATIONS)
    simplex = np.concatenate([start[None], start + FIRST_SIMPLEX * np.eye(len(start))])
    options = {
        "initial_simplex": np.clip(simplex, low, high),
        "xatol": 1e-3,
        "fatol": 1e-9,
        "maxiter": ITERATIONS * len(start),
    }
    found = minimize(
        lambda point: float(np.fmin(cost(point[None]), wall)[0]),
        start,
        method="Nelder-Mead",
        bounds=of_bounds,
        options=options,
    )
    return found.x, bool(found.success)


class Beside(NamedTuple):
    """Holds what a point (k,) costs, and what it costs beside it along m of its coordinates.

    Attributes:
        here: at the point.
        ahead, behind: (m,) a step further and less far.
        steps: (m,) how far.
    """

    here: float
    ahead: Floats
    behind: Floats
    steps: Floats

    @property
    def slopes(self) -> Floats:
        """Return the first derivatives (m,)."""
        return (self.ahead - self.behind) / (2.0 * self.steps)

    @property
    def bends(self) -> Floats:
        """Return the second derivatives (m,); not finite where a cost is not."""
        with np.errstate(invalid="ignore"):
            return (self.ahead - 2.0 * self.here + self.behind) / self.steps**2


def beside(cost: Cost, point: Floats, places: Iterable[int], steps: float | Floats) -> Beside:
    """Compute what it costs beside a point.

    Args:
        cost: of points (n, k).
        point: (k,).
        places: m of the k coordinates.
        steps: how far along each of these, for all of them or (m,).
    """
    return _differences(cost, point, list(places), steps, [])[0]


def curvature(
    cost: Cost, point: Floats, places: Iterable[int], steps: float | Floats
) -> tuple[Beside, Floats]:
    """Compute the second derivatives of a cost at a point by m of its coordinates.

    Args:
        cost: of points (n, k).
        point: (k,).
        places: m of the k coordinates.
        steps: of the differences, of all coordinates or (m,).

    Returns:
        What it costs beside the point, and (m, m); not finite where the cost beside the point is not.
    """
    rows = list(places)
    pairs = list(combinations(range(len(rows)), 2))
    around, crossed = _differences(cost, point, rows, steps, pairs)
    found = np.diag(around.bends)
    for (i, j), (both, plus, minus, neither) in zip(pairs, crossed, strict=True):
        with np.errstate(invalid="ignore"):
            mixed = (both - plus - minus + neither) / 4.0
        found[i, j] = found[j, i] = mixed / (around.steps[i] * around.steps[j])
    return around, found


def _differences(
    cost: Cost,
    point: Floats,
    places: Sequence[int],
    steps: float | Floats,
    pairs: Sequence[tuple[int, int]],
) -> tuple[Beside, Floats]:
    """Compute the costs along coordinates, and at four corners of each pair of these, all together."""
    m, h = len(places), np.broadcast_to(steps, len(places))
    along = h[:, None] * np.eye(len(point))[places]
    corners = [
        point + first * along[i] + second * along[j]
        for i, j in pairs
        for first, second in product((1, -1), repeat=2)
    ]
    costs = cost(np.array([point, *(point + along), *(point - along), *corners]))
    ahead, behind, crossed = np.split(costs[1:], [m, 2 * m])
    return Beside(float(costs[0]), ahead, behind, h), crossed.reshape(-1, 4)


def profile_ends(
    cost: Cost,
    point: Floats,
    curvature: Floats,
    *,
    corrections: int = 0,
    within: float = END,
    doublings: int = DOUBLINGS,
) -> tuple[Floats, Floats]:
    """Find the ends of the 95 % intervals of numbers: along each, all others follow by the curvature.

    Args:
        cost: minus the log-likelihood, of points (n, k).
        point: (k,) where it is least.
        curvature: (k, k) its second derivatives there.
        corrections: Newton's steps of the others at each value, where the curvature alone leads astray.
        within: the share of an end that it need not be known better by.
        doublings: of the way to an end.

    Returns:
        The ends (k,), (k,); infinite where none is found.
    """
    covariance = np.linalg.pinv(curvature)
    errors = np.sqrt(np.diagonal(covariance))
    along = covariance / errors  # a column for each number
    ways = [(place, way * QUANTILE) for place in range(len(point)) for way in (-1.0, 1.0)]

    def gains(asked: Sequence[tuple[int, float]]) -> Sequence[float]:
        points = np.array([point + by * along[:, ways[search][0]] for search, by in asked])
        for _ in range(corrections if len(point) > 1 else 0):
            for row, (search, _) in zip(points, asked, strict=True):
                others = [place for place in range(len(point)) if place != ways[search][0]]
                slopes = beside(cost, row, others, 0.05 * errors[others]).slopes
                row[others] -= np.linalg.pinv(curvature[np.ix_(others, others)]) @ slopes
        return [-each for each in cost(points).tolist()]

    [least] = cost(point[None])
    ends = side_by_side([end(0.0, -float(least), way, within, doublings) for _, way in ways], gains)
    low, high = np.reshape(ends, (-1, 2)).T * errors + point
    return low, high


def end(
    at: float, gain: float, scale: float, within: float = END, doublings: int = DOUBLINGS
) -> Search[float, float]:
    """Search for an end of the 95 % interval of a number: where its gain is DROP_95 below its greatest.

    `scale` is how far off it is about, with its side. An end that is not found is infinite. The gain is
    about a parabola, so that the root of what it falls by is about a line. If the gain is a spike, the
    bracket stops narrowing after `NARROWINGS` values and its outer end is returned.
    """

    def root_of_fall(gains: Sequence[float]) -> float:
        [found] = gains
        return float(np.sqrt(min(gain - found if found < gain else 0.0, LARGEST)))

    inner, outer = at, at + scale
    least, fallen = 0.0, 0.0
    for _ in range(doublings):
        fallen = root_of_fall((yield [outer]))
        if fallen > ROOT_95:
            break
        inner, outer, least = outer, outer + (outer - at), fallen
    else:
        return float(np.copysign(np.inf, scale))
    value, most = outer, fallen
    for _ in range(NARROWINGS):
        if abs(fallen / ROOT_95 - 1.0) <= within or abs(outer - inner) <= within * abs(outer - at):
            return value
        share = float(np.clip((ROOT_95 - least) / (most - least), *SHARES))
        value = inner + share * (outer - inner)
        if value in (inner, outer):  # numbers have no room between them
            break
        fallen = root_of_fall((yield [value]))
        if fallen > ROOT_95:
            outer, most = value, fallen
        else:
            inner, least = value, fallen
    return outer


def side_by_side(
    searches: Sequence[Search[Asked, Found]],
    gains_of: Callable[[Sequence[tuple[int, Asked]]], Sequence[float]],
) -> list[Found]:
    """Run searches together, by the gains of what all of them ask for: places and values.

    A gain that is NaN counts as minus infinity: a value that cannot be used.
    """
    asked = {place: list(next(search)) for place, search in enumerate(searches)}
    results: dict[int, Found] = {}
    while asked:
        gains = gains_of([(place, at) for place, each in asked.items() for at in each])
        found = iter(-np.inf if np.isnan(gain) else gain for gain in gains)
        answers = {place: [next(found) for _ in each] for place, each in asked.items()}
        asked = {}
        for place, answer in answers.items():
            try:
                asked[place] = list(searches[place].send(answer))
            except StopIteration as stop:
                results[place] = stop.value
    return [results[place] for place in range(len(searches))]
