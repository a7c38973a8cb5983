"""Minimisation of a cost, its curvature at the minimum, and 95 % likelihood intervals.

A cost, such as the negative log-likelihood, is evaluated at many points per call, so its evaluations can
be distributed. Begin with `minimum`. `Beside` contains the costs around a point, and `profile_ends`
finds intervals.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from itertools import combinations, product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Floats = NDArray[np.float64]
# Points (n, k) -> cost of each (n,); infinite for a point that cannot be evaluated.
Cost = Callable[[Floats], Floats]
# A search yields values to try, is sent their gains, and returns its result.
Asked = TypeVar("Asked")
Found = TypeVar("Found")
Search = Generator[Sequence[Asked], Sequence[float], Found]

QUANTILE = float(ndtri(0.975))
DROP_95 = 0.5 * QUANTILE**2  # drop of the log-likelihood from its maximum to an end of the 95 % interval
ROOT_95 = DROP_95**0.5
STEP = 1e-4  # step of the finite differences for a gradient
ITERATIONS = 200
TOLERANCE = 1e-13  # smallest relative decrease of the cost per iteration
FIRST_SIMPLEX = 0.7  # edge length of the initial simplex
END = 1e-3  # relative accuracy of an interval end
SHARES = 0.05, 0.95  # bounds of the next value, as shares of the bracket
DOUBLINGS = 12  # most doublings of the step while an end is bracketed
NARROWINGS = 40  # most iterations that narrow a bracket
ROUNDING = 1e-13  # relative error of a cost: the sum of about 1e5 to 1e6 rounded terms
LARGEST = 1e12  # largest drop of a gain, for values that cannot be evaluated


def minimum(
    cost: Cost,
    start: Floats,
    bounds: tuple[Floats, Floats],
    *,
    is_smooth: bool = True,
    tolerance: float = TOLERANCE,
) -> tuple[Floats, bool]:
    """Minimise a cost from a start, by L-BFGS-B, or by the Nelder-Mead simplex if the cost is rough.

    Args:
        cost: function that computes the costs (n,) of points (n, k).
        start: (k,) the point at which the search starts.
        bounds: lower bounds (k,) and upper bounds (k,).
        is_smooth: whether the cost has a usable gradient.
        tolerance: the relative decrease of a smooth cost below which the search stops.

    Returns:
        The minimum (k,), and whether the search converged.
    """
    low, high = bounds
    from scipy.optimize import minimize  # slow to import

    # points that cannot be evaluated get a high finite cost, so that the search turns back
    at_start = float(cost(start[None])[0])
    wall = (10.0 * abs(at_start) if np.isfinite(at_start) else 0.0) + 1e6

    def with_gradient(point: Floats) -> tuple[float, Floats]:
        """Compute the cost and its slopes; a slope towards a point that cannot be evaluated is zero."""
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
    """Costs at a point (k,), and one step away on both sides of it, along m of its coordinates.

    Attributes:
        here: the cost at the point.
        ahead, behind: (m,) the costs one step forwards and one step backwards.
        steps: (m,) the steps.
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
        """Return the second derivatives (m,); a derivative is not finite if a cost is not finite."""
        with np.errstate(invalid="ignore"):
            return (self.ahead - 2.0 * self.here + self.behind) / self.steps**2


def beside(cost: Cost, point: Floats, places: Iterable[int], steps: float | Floats) -> Beside:
    """Evaluate a cost at a point, and one step away on both sides of it along m coordinates.

    Args:
        cost: function that computes the costs (n,) of points (n, k).
        point: (k,).
        places: indices of m of the k coordinates.
        steps: one step for all m coordinates, or (m,) a step for each.
    """
    return _differences(cost, point, list(places), steps, [])[0]


def curvature(
    cost: Cost, point: Floats, places: Iterable[int], steps: float | Floats
) -> tuple[Beside, Floats]:
    """Compute the second derivatives of a cost at a point with respect to m of its coordinates.

    Args:
        cost: function that computes the costs (n,) of points (n, k).
        point: (k,).
        places: indices of m of the k coordinates.
        steps: one step of the finite differences for all m coordinates, or (m,) a step for each.

    Returns:
        The costs around the point, and the derivatives (m, m); a derivative is not finite if a cost from
        which it is computed is not.
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


def rises(around: Beside, curvature: Floats) -> bool:
    """Test whether a cost bends upwards in every direction, by more than rounding may explain.

    An element of the curvature is a difference of four costs, divided by the product of two steps. An
    error of `ROUNDING` in each cost changes no eigenvalue by more than the sum, over all coordinates, of
    four such errors divided by the square of the step.

    Args:
        around: the costs from which the curvature was computed.
        curvature: (m, m) the second derivatives, which may not be finite.
    """
    if not len(curvature):
        return True
    if not np.isfinite(curvature).all():
        return False
    largest = np.max(np.abs([around.here, *around.ahead, *around.behind]))
    error = 4.0 * ROUNDING * largest * np.sum(np.square(1.0 / around.steps))
    return bool(np.linalg.eigvalsh(curvature)[0] > error)


def _differences(
    cost: Cost,
    point: Floats,
    places: Sequence[int],
    steps: float | Floats,
    pairs: Sequence[tuple[int, int]],
) -> tuple[Beside, Floats]:
    """Compute costs along coordinates, and at the four corners of each pair of them, in one call."""
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
    """Find the ends of each coordinate's 95 % interval; the curvature predicts the other coordinates.

    Args:
        cost: function that computes minus the log-likelihoods of points (n, k).
        point: (k,) the minimum.
        curvature: (k, k) the second derivatives at the minimum.
        corrections: the number of Newton steps by which the other coordinates are optimised again at
            each value; use it for costs that the curvature alone does not describe.
        within: the relative accuracy of an end.
        doublings: the largest number of doublings of the step while an end is bracketed.

    Returns:
        The lower ends (k,) and the upper ends (k,); infinite if no end is found.
    """
    covariance = np.linalg.pinv(curvature)
    errors = np.sqrt(np.diagonal(covariance))
    along = covariance / errors  # one column per number
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
    """Search for an end of a number's 95 % interval, where the gain has dropped by DROP_95.

    `scale` is an estimate of the signed distance from `at` to the end. If no end is found, the result is
    infinite. The gain is nearly a parabola, so the square root of its drop is nearly linear. If the gain
    is a narrow spike, the bracket stops narrowing after `NARROWINGS` values, and the bracket's outer end
    is returned.
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
        if value in (inner, outer):  # no floating-point number lies between them
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
    """Run searches in parallel; the values that they request are evaluated together.

    `gains_of` computes the gains of pairs: the index of a search, and a value. A gain of NaN counts as
    minus infinity.
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
