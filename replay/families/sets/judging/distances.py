"""Distances between sets of points: OSPA, and GOSPA with its parts.

Sources: Schuhmacher, Vo, Vo, "A consistent metric for performance evaluation of multi-object filters",
IEEE TSP 56(8), 2008 (OSPA); Rahmathullah, Garcia-Fernandez, Svensson, "Generalized optimal sub-pattern
assignment metric", FUSION 2017 (GOSPA).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Gospa(NamedTuple):
    """GOSPA and its parts: total**order = localisation + missed + false."""

    total: float
    localisation: float
    missed: float
    false: float


def ospa(estimates: ArrayLike, truths: ArrayLike, cutoff: float, order: float = 1.0) -> float:
    """Compute the OSPA of point sets, which is between 0 and the cutoff, in the unit of the points.

    Raises BadInput as `gospa` does.

    Args:
        estimates: (n, d).
        truths: (m, d).
        cutoff: upper limit of a distance.
        order: order of the mean, at least 1.
    """
    costs = _assigned_costs(estimates, truths, cutoff, order)
    most = max(costs.estimates, costs.truths)
    if most == 0:
        return 0.0
    alone = most - len(costs.pairs)
    return float((np.sum(costs.pairs) + alone * cutoff**order) / most) ** (1.0 / order)


def gospa(
    estimates: ArrayLike, truths: ArrayLike, cutoff: float, order: float = 2.0, alpha: float = 2.0
) -> Gospa:
    """Compute the GOSPA of point sets, and its parts raised to the power of the order.

    With alpha = 2, points whose distance reaches the cutoff are not paired; they count as one missed and
    one false point. With any other alpha, only the surplus points of the larger set count as missed or
    false.

    Raises BadInput if the points are not finite or have different dimensions, the cutoff is not
    positive, the order is below 1, or alpha is not in (0, 2].

    Args:
        estimates: (n, d).
        truths: (m, d).
        cutoff: upper limit of a distance, in the unit of the points.
        order: order of the sum, at least 1.
        alpha: determines the cost of a surplus point, which is cutoff^order / alpha.
    """
    if not 0.0 < alpha <= 2.0:
        raise BadInput(f"alpha {alpha:g}: alpha must be above 0 and at most 2")
    costs = _assigned_costs(estimates, truths, cutoff, order)
    pairs = costs.pairs
    if alpha == 2.0:
        pairs = pairs[pairs < cutoff**order]
        unpaired = len(pairs), len(pairs)
    else:
        unpaired = costs.truths, costs.estimates
    alone = cutoff**order / alpha
    localisation = float(np.sum(pairs))
    missed = alone * max(costs.truths - unpaired[1], 0)
    false = alone * max(costs.estimates - unpaired[0], 0)
    return Gospa((localisation + missed + false) ** (1.0 / order), localisation, missed, false)


def gospa_pairs(
    estimates: ArrayLike, truths: ArrayLike, cutoff: float, order: float = 2.0
) -> tuple[Integers, Integers]:
    """Find the pairs of GOSPA with alpha = 2, as indices (m,) of estimates and of truths.

    Raises BadInput as `gospa` does.

    Args:
        estimates: (n, d).
        truths: (m, d).
        cutoff: greatest distance of a pair.
        order: order of the sum, at least 1.
    """
    costs = _assigned_costs(estimates, truths, cutoff, order)
    near = costs.pairs < cutoff**order
    return costs.estimate[near], costs.truth[near]


class _Costs(NamedTuple):
    """Sizes of the sets, and the best pairs with their distances raised to the power of the order."""

    estimates: int
    truths: int
    pairs: Floats
    estimate: Integers
    truth: Integers


def _assigned_costs(estimates: ArrayLike, truths: ArrayLike, cutoff: float, order: float) -> _Costs:
    """Form as many pairs as possible, with the smallest total cost."""
    from scipy.optimize import linear_sum_assignment  # slow to import
    from scipy.spatial.distance import cdist

    if not (0.0 < cutoff < np.inf and 1.0 <= order < np.inf):
        raise BadInput(
            f"cutoff {cutoff:g}, order {order:g}: the cutoff must be positive, and the order at least 1"
        )
    first, second = _points(estimates, "estimates"), _points(truths, "truths")
    if len(first) == 0 or len(second) == 0:
        nobody = np.empty(0, np.int64)
        return _Costs(len(first), len(second), np.empty(0), nobody, nobody)
    if first.shape[1] != second.shape[1]:
        raise BadInput(
            f"estimates have {first.shape[1]} components and truths {second.shape[1]}; both must have "
            "the same number"
        )
    costs = np.minimum(cdist(first, second), cutoff) ** order
    estimate, truth = linear_sum_assignment(costs)
    return _Costs(len(first), len(second), costs[estimate, truth], estimate, truth)


def _points(points: ArrayLike, what: str) -> Floats:
    found = np.asarray(points, float)
    if found.size == 0:
        return np.empty((0, 0))
    if found.ndim != 2 or not np.isfinite(found).all():
        raise BadInput(f"{what}: expected finite points (n, d), found shape {found.shape}; remove NaN")
    return found
