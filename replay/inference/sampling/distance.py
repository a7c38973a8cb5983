"""Distance of a sample set from N(0, I), by localized cumulative distributions (LCD).

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
Definition V.2 and (26): the modified Cramér-von Mises distance D, here divided by pi^(N/2). The paper
does not specify b_max; here it is B = 10.

D is a small difference of large terms. With weights w_i and d = |s_i - s_j|^2, (26) integrates to

    D3 = B^2 / 2 sum_ij w_i w_j E2(d / 4B^2),
    D2 = sum_i w_i integral_0^B b (2b^2 / (1 + 2b^2))^(N/2) exp(-|s_i|^2 / (2 + 4b^2)) db.

To keep digits, 1 is subtracted from E2 and exp before they are summed over the samples; the terms that
do not depend on the samples are computed once.
"""

from functools import lru_cache
from math import exp, factorial, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.errors import BadInput

Array = NDArray[np.float64]

B_MAX = 10.0
PANELS = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, B_MAX])
NODES_PER_PANEL = 12  # exact to rounding for N up to 100

# Exponential integrals for u <= 1: E1 = -log u + sum_k E1_SERIES[k] u^k and
# E2 - 1 = u (log u + sum_k E2_SERIES[k] u^k). The first omitted term is below 1e-18.
TERMS = 19
E1_SERIES = (-np.euler_gamma, *(-((-1.0) ** k) / (k * factorial(k)) for k in range(1, TERMS)))
E2_SERIES = (np.euler_gamma - 1, *((-1.0) ** k / (k * factorial(k + 1)) for k in range(1, TERMS)))


class _Quadrature(NamedTuple):
    """Quadrature of integrals over b: D2(s) = sum_q factors[q] exp(-rates[q] |s|^2)."""

    rates: Array
    factors: Array
    constant: float
    """The distance D of a set whose samples are all at the origin."""


def lcd_distance(points: Array, weights: Array | None = None) -> float:
    """Compute D / pi^(N/2) between a sample set and N(0, I).

    Args:
        points: (L, N).
        weights: (L,), summing to 1, possibly negative; equal by default.

    Raises:
        BadInput: the shapes do not match, a value is not finite, or the weights do not sum to 1.
    """
    if points.ndim != 2 or 0 in points.shape or not np.isfinite(points).all():
        raise BadInput(
            f"the samples must be finite and of shape (count, dimension); found {points.shape}"
        )
    if weights is None:
        weights = np.full(len(points), 1 / len(points))
    if weights.shape != points.shape[:1] or not abs(weights.sum() - 1) < 1e-9:
        raise BadInput(f"{len(points)} samples need the same number of weights, with sum 1")
    return lcd_distance_and_gradient(points, weights)[0]


def lcd_distance_and_gradient(points: Array, weights: Array) -> tuple[float, Array]:
    """Compute D / pi^(N/2) and its gradient (L, N) with respect to the points, without checks."""
    rates, factors, constant = _quadrature(points.shape[1])
    decays = np.expm1(-np.multiply.outer(np.sum(points**2, axis=1), rates))
    pulls = 4 * np.vecdot(decays + 1, factors * rates)
    coordinates = np.ascontiguousarray(points.T)
    pair_gradient, work = np.zeros(coordinates.shape), np.zeros((3 + len(points), len(points)))
    pairs = _pair_sum(coordinates, weights, pair_gradient, work)
    distance = constant - 2 * weights @ np.vecdot(decays, factors) + pairs
    return float(distance), (weights * pulls)[:, None] * points + pair_gradient.T


@lru_cache
def _quadrature(dimension: int) -> _Quadrature:
    nodes, node_weights = np.polynomial.legendre.leggauss(NODES_PER_PANEL)
    halves = np.diff(PANELS) / 2
    b = (PANELS[:-1] + halves + np.multiply.outer(nodes, halves)).ravel()
    db = np.multiply.outer(node_weights, halves).ravel()
    squared = b**2
    first = (squared / (1 + squared)) ** (dimension / 2)
    second = (2 * squared / (1 + 2 * squared)) ** (dimension / 2)
    return _Quadrature(
        rates=1 / (2 + 4 * squared),
        factors=db * b * second,
        constant=float(np.sum(db * b * (first - 2 * second + 1))),
    )


# The expensive loops below do not sum over their innermost index, so a compiler can vectorise them
# without reordering. With fastmath, the results depended on the state of numba's cache.


def _sum_pairs(coordinates: Array, weights: Array, gradient: Array, work: Array) -> float:
    """Sum B^2/2 w_i w_j (E2 - 1) over all i, j, and add its gradient (N, L), for coordinates (N, L).

    `work` (3 + L, L) must be zero.
    """
    dimension, count = coordinates.shape
    u, e1, e2, pulls = work[0], work[1], work[2], work[3:]
    total = 0.0
    for i in range(1, count):
        u[:i] = 0.0
        for axis in range(dimension):
            for j in range(i):
                u[j] += (coordinates[axis, i] - coordinates[axis, j]) ** 2
        for j in range(i):
            u[j] = max(u[j], 1e-300) / (4 * B_MAX**2)
        _exponential_integrals(u[:i], e1[:i], e2[:i])
        for j in range(i):
            total += weights[i] * weights[j] * e2[j]
            pulls[i, j] = pulls[j, i] = weights[i] * weights[j] * e1[j] / 2
    for axis in range(dimension):
        for j in range(count):
            for i in range(count):
                gradient[axis, i] += pulls[j, i] * (coordinates[axis, j] - coordinates[axis, i])
    return B_MAX**2 * total


_pair_sum = compiled(_sum_pairs)


def _exponential_integrals(u: Array, e1: Array, e2: Array) -> None:
    """Fill e1 with E1(u) and e2 with E2(u) - 1, by the series or, for u > 1, a continued fraction."""
    for j in range(len(u)):
        e2[j] = log(u[j])
    for j in range(len(u)):
        first = 0.0
        second = 0.0
        for k in range(TERMS - 1, -1, -1):
            first = first * u[j] + E1_SERIES[k]
            second = second * u[j] + E2_SERIES[k]
        e1[j] = first - e2[j]
        e2[j] = u[j] * (second + e2[j])
    for j in range(len(u)):
        if u[j] > 1:
            e1[j], e2[j] = _exponential_integrals_beyond_one(u[j])


def _exponential_integrals_beyond_one(u: float) -> tuple[float, float]:
    """Compute E1(u) and E2(u) - 1 for u > 1 by the continued fraction of E1, evaluated from its end."""
    tail = 0.0
    for k in range(20 + int(80 / u), 0, -1):
        tail = k / (1 + k / (u + tail))
    e1 = exp(-u) / (u + tail)
    return e1, exp(-u) - 1 - u * e1
