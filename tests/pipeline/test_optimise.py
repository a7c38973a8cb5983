"""Minima, curvatures and 95 % ends of costs that are known in closed form."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.special import gammaln

from fuselog.pipeline.optimise import DROP_95, QUANTILE, beside, curvature, minimum, profile_ends, rises

CURVATURE = np.array([[4.0, 1.2, 0.0], [1.2, 1.0, -0.3], [0.0, -0.3, 9.0]])
MIDDLE = np.array([0.3, -2.0, 1.0])


def parabola(points: Any) -> Any:
    return 0.5 * np.einsum("ni,ij,nj->n", points - MIDDLE, CURVATURE, points - MIDDLE) + 7.0


def of_gamma(points: Any) -> Any:
    """Minus the log-likelihood of ten numbers, of mean 2, by the logarithms of shape and scale."""
    shape, scale = np.exp(points).T
    return 10.0 * (gammaln(shape) + shape * np.log(scale) + 2.0 / scale) - 6.0 * (shape - 1.0)


@pytest.mark.parametrize("is_smooth", [True, False])
def test_a_minimum_is_found_beside_a_wall(*, is_smooth: bool) -> None:
    """Where the first number is above 0.2 nothing can be used; there the others follow."""

    def walled(points: Any) -> Any:
        return np.where(points[:, 0] > 0.2, np.inf, parabola(points))

    bounds = np.full(3, -10.0), np.full(3, 10.0)
    others = MIDDLE[1:] + np.linalg.solve(CURVATURE[1:, 1:], 0.1 * CURVATURE[1:, 0])
    for cost, at in ((parabola, MIDDLE), (walled, np.array([0.2, *others]))):
        found, _ = minimum(cost, np.zeros(3), bounds, is_smooth=is_smooth)
        assert cost(found[None]) < parabola(at[None]) + 0.01


def test_differences_of_a_parabola_are_exact() -> None:
    point, places = np.array([1.0, 0.0, 0.5]), [2, 0]
    around, bent = curvature(parabola, point, places, np.array([0.1, 0.5]))
    assert bent == pytest.approx(CURVATURE[np.ix_(places, places)])
    assert around.slopes == pytest.approx((CURVATURE @ (point - MIDDLE))[places])
    assert beside(parabola, point, places, 0.1).bends == pytest.approx([9.0, 4.0])
    _, edged = curvature(
        lambda points: np.where(points[:, 0] > 1.0, np.inf, parabola(points)), point, places, 0.1
    )
    assert np.isfinite(edged).tolist() == [[True, False], [False, False]]


@pytest.mark.parametrize(("bend", "is_one"), [(-1e-7, False), (0.0, False), (1e-7, False), (1e-3, True)])
def test_a_direction_that_bends_less_than_rounding_is_none(bend: float, *, is_one: bool) -> None:
    """Costs of 1e4 are off by 1e-9, which steps of 0.1 make 1e-7 times 4 of a curvature, twice."""
    flat = np.ones((2, 2)) + 0.5 * bend * np.array([[1.0, -1.0], [-1.0, 1.0]])
    around, bent = curvature(
        lambda points: 1e4 + 0.5 * np.einsum("ni,ij,nj->n", points, flat, points),
        np.zeros(2),
        range(2),
        0.1,
    )
    assert rises(around, bent) == is_one
    assert rises(around, np.empty((0, 0)))
    assert not rises(around, np.full((2, 2), np.nan))


def test_ends_of_a_parabola_are_its_standard_errors() -> None:
    errors = np.sqrt(np.diagonal(np.linalg.inv(CURVATURE)))
    low, high = profile_ends(parabola, MIDDLE, CURVATURE)
    assert low == pytest.approx(MIDDLE - QUANTILE * errors, rel=1e-3)
    assert high == pytest.approx(MIDDLE + QUANTILE * errors, rel=1e-3)


def test_ends_of_a_likelihood_are_where_its_profile_has_fallen() -> None:
    best, _ = minimum(of_gamma, np.zeros(2), (np.full(2, -9.0), np.full(2, 9.0)))
    _, bent = curvature(of_gamma, best, range(2), 1e-3)
    low, high = profile_ends(of_gamma, best, bent, corrections=4, within=1e-5)

    def fallen(value: float, place: int) -> float:
        def along(other: float) -> float:
            return float(of_gamma(np.roll([[value, other]], place, axis=1))[0])

        rise = minimize_scalar(along, bracket=(-1.0, 1.0)).fun - float(of_gamma(best[None])[0])
        return float(rise - DROP_95)

    for place in range(2):
        wanted = [brentq(fallen, best[place], best[place] + way, args=(place,)) for way in (-3.0, 3.0)]
        assert [low[place], high[place]] == pytest.approx(wanted, abs=4e-3)
    _, by_curvature = profile_ends(of_gamma, best, bent)
    assert high[1] - by_curvature[1] > 0.01  # where the others do not follow, it ends too early


def test_an_end_that_is_nowhere_is_infinite() -> None:
    low, high = profile_ends(lambda points: np.exp(-points[:, 0]), np.zeros(1), np.ones((1, 1)))
    assert (np.isfinite(low[0]), high[0]) == (True, np.inf)
