"""Search for the parameters with the lowest cost.

Positive parameters, such as standard deviations, are searched as logarithms. Every other parameter is
searched in a unit of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.optimise import ITERATIONS, TOLERANCE, Cost, Search, minimum, side_by_side
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameter

Floats = NDArray[np.float64]

CURVATURE_STEP = 1e-2  # step of the finite differences, in coordinates
DESCENTS = 20  # the search stops when no change of a single parameter reduces the cost by more
# factors by which a scan changes a positive parameter
FACTORS = 10.0 ** np.array([-1.0, -0.5, -0.2, 0.2, 0.5, 1.0])
# changes of a calibration parameter in a scan, in useful units
MOVES = np.array([-10.0, -6.0, -3.0, -1.0, 1.0, 3.0, 6.0, 10.0])
LEAST_GAIN = 1e-3  # smallest gain of a scan's step, far less than any log can resolve
LOOKS = 3  # number of attempts to find the scale of a parameter that is not positive
UNIT = 10.0  # standard errors of the parameter if all others are fixed

MOST_GRID_POINTS = 10_000


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of k parameters: logarithms, or values in the parameters' own units."""

    free: Sequence[Parameter]
    units: Floats

    def of(self, values: Floats) -> Floats:
        """Compute the coordinates (..., k) of values."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self._is_log, np.log(values), values / self.units)

    def values(self, coordinates: Floats) -> Floats:
        """Compute the values (..., k) at coordinates, clipped to the bounds."""
        return np.clip(self.unbounded(coordinates), *self._ends)

    def unbounded(self, coordinates: Floats) -> Floats:
        """Compute the values (..., k) at coordinates that may be outside the bounds."""
        with np.errstate(over="ignore"):
            return np.where(self._is_log, np.exp(coordinates), coordinates * self.units)

    def over(self, cost: Cost) -> Cost:
        """Convert a cost of values to a cost of coordinates (n, k)."""
        return lambda points: cost(self.values(points))

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Return the lower and upper bounds (k,), (k,) in coordinates."""
        low, high = map(self.of, self._ends)
        return low, high

    def at_bounds(self, point: Floats) -> NDArray[np.bool_]:
        """Test which coordinates (k,) of a point are at a bound."""
        low, high = self.bounds
        return (point - low < CURVATURE_STEP) | (high - point < CURVATURE_STEP)

    @property
    def _is_log(self) -> NDArray[np.bool_]:
        return np.array([each.is_log for each in self.free])

    @property
    def _ends(self) -> tuple[Floats, Floats]:
        return np.array([each.low for each in self.free]), np.array([each.high for each in self.free])


def coordinates_of(cost: Cost, free: Sequence[Parameter], about: Floats) -> Coordinates:
    """Choose the coordinates of a search.

    Args:
        cost: function that computes the costs of values (n, k).
        free: the k parameters.
        about: (k,), the values around which the curvature of the cost determines the units.

    Returns:
        The coordinates.

    Raises BadInput if the cost does not depend on a parameter.
    """
    places = [place for place, each in enumerate(free) if not each.is_fixed]

    def gains(asked: Sequence[tuple[int, float]]) -> Sequence[float]:
        points = np.tile(about, (len(asked), 1))
        for row, (search, change) in zip(points, asked, strict=True):
            place = places[search]
            row[place] = np.clip(row[place] + change, free[place].low, free[place].high)
        return [-each for each in cost(points).tolist()]

    units = np.ones(len(free))
    units[places] = side_by_side([_unit(free[place], float(about[place])) for place in places], gains)
    return Coordinates(free, units)


def _unit(of: Parameter, value: float) -> Search[float, float]:
    """Search for the unit of a parameter's coordinate: 1 for a logarithm, else `UNIT` standard errors.

    The standard error follows from the curvature of the cost at the value. Raises BadInput if the cost
    does not depend on the parameter.
    """
    unit = 1.0
    if of.is_log:
        below, middle, above = yield [-0.3 * value, 0.0, 0.3 * value]
    else:
        step = 1e-3 * max(abs(value), 1.0)
        for _ in range(LOOKS):  # the cost is not a parabola here, so a smaller or larger step is used
            below, middle, above = yield [-step, 0.0, step]
            with np.errstate(invalid="ignore"):  # infinite gains have no curvature
                bend = np.float64(2.0 * middle - below - above) / step**2
            step = float(bend**-0.5 if 0.0 < bend < np.inf else step * (10.0 if bend <= 0.0 else 0.1))
        unit = UNIT * step
    if below == middle == above:
        raise BadInput(
            f"{of.name}: the logs do not depend on it, so they cannot determine its value; remove "
            "it from --free"
        )
    return unit


def least_of_grid(cost: Cost, coordinates: Coordinates, points: int) -> Floats:
    """Return the start (k,) in coordinates, or the grid point between the bounds if its cost is lower.

    Raises BadInput if a bound is infinite or the grid has too many points.
    """
    low, high = coordinates.bounds
    for each, begin, end in zip(coordinates.free, low, high, strict=True):
        if not np.isfinite(end - begin):
            raise BadInput(f"{each.name}: a grid needs bounds; give --bound {each.name}=LOW:HIGH")
    count = points ** len(low)
    if count > MOST_GRID_POINTS:
        raise BadInput(
            f"--grid {points}: this gives {count} points for {len(low)} parameters; give a coarser "
            f"grid, of at most {MOST_GRID_POINTS} points"
        )
    axes = [np.linspace(begin, end, points) for begin, end in zip(low, high, strict=True)]
    start = coordinates.of(np.array([each.default for each in coordinates.free]))
    tried = np.array([start, *product(*axes)])
    return tried[np.argmin(coordinates.over(cost)(tried))]


def least(
    cost: Cost,
    coordinates: Coordinates,
    start: Floats,
    *,
    is_smooth: bool,
    tolerance: float = TOLERANCE,
) -> tuple[Floats, bool]:
    """Find the minimum of a cost.

    A descent from a distant start can end in a local minimum, such as one in which two modes are
    swapped, or the spike of a diverging filter. The search therefore begins and ends at points at which
    no change of a single parameter by one of `FACTORS`, or of a calibration parameter by one of `MOVES`,
    reduces the cost.

    Args:
        cost: function that computes the costs of values (n, k).
        coordinates: the coordinates of the search.
        start: (k,), in coordinates.
        is_smooth: whether the cost has a gradient that the search can follow.
        tolerance: the relative decrease of a smooth cost below which the search ends.

    Returns:
        The minimum (k,) in coordinates, and whether the search converged.
    """
    point = scanned(cost, coordinates, start)
    for _ in range(DESCENTS):
        ended, has_converged = _minimum(
            cost, coordinates, point, is_smooth=is_smooth, tolerance=tolerance
        )
        point = scanned(cost, coordinates, ended)
        if point is ended or not has_converged:
            return ended, has_converged
    return point, False


def scanned(cost: Cost, coordinates: Coordinates, start: Floats) -> Floats:
    """Move to a point from which no change of a single parameter reduces the cost; see `least`.

    The scan ends after `ITERATIONS` changes if the cost keeps falling.

    Args:
        cost: function that computes the costs of values (n, k).
        coordinates: the coordinates of the search.
        start: (k,), in coordinates.

    Returns:
        The point (k,), in coordinates.
    """
    low, high = coordinates.bounds
    changes = np.concatenate(
        [
            (np.log(FACTORS) if each.is_log else MOVES * each.useful / unit)[:, None] * along
            for along, unit, each in zip(
                np.eye(len(start)), coordinates.units, coordinates.free, strict=True
            )
            if not each.is_fixed and (each.is_log or each.useful)
        ]
        or [np.empty((0, len(start)))]
    )
    point = start
    for _ in range(ITERATIONS):
        points = np.clip(np.array([point, *(point + changes)]), low, high)
        costs = np.fmin(cost(coordinates.values(points)), np.inf)  # NaN cannot be used either
        best = int(np.argmin(costs))
        if best == 0 or costs[best] > costs[0] - LEAST_GAIN:
            break
        point = points[best]
    return point


def _minimum(
    cost: Cost, coordinates: Coordinates, start: Floats, *, is_smooth: bool, tolerance: float
) -> tuple[Floats, bool]:
    """Find a local minimum (k,) by descent, and whether the descent converged."""
    bounds = coordinates.bounds
    if all(each.is_fixed for each in coordinates.free):
        return bounds[0], True
    return minimum(coordinates.over(cost), start, bounds, is_smooth=is_smooth, tolerance=tolerance)
