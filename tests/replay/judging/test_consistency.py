"""NEES, ellipses and dilution against numbers worked out by hand."""

import numpy as np
import pytest

from fuselog.replay.engine.vectors.covariances import errors_squared, normalized_error_squared
from fuselog.replay.judging.consistency.consistency import (
    component_error_squared,
    dilution_of_precision,
    ellipse_area,
)


def test_nees_of_mixed_units() -> None:
    """Metres beside microradians, correlated."""
    sigma = np.array([1e4, 1e-6])
    covariance = np.outer(sigma, sigma) * [[1.0, 0.5], [0.5, 1.0]]
    error = np.array([[2e4, 1e-6], [0.0, 0.0]])
    # (4 - 2 * 0.5 * 2 + 1) / (1 - 0.25)
    np.testing.assert_allclose(normalized_error_squared(error, covariance), [4.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(component_error_squared(error, covariance)[0], [4.0, 1.0])


def test_infinite_variance_counts_nothing_and_nan_stays_nan() -> None:
    covariance = np.array([np.diag([4.0, np.inf]), np.diag([np.nan, 1.0])])
    nees = normalized_error_squared(np.array([2.0, 5.0]), covariance)
    assert nees[0] == pytest.approx(1.0)
    assert np.isnan(nees[1])


def test_singular_covariance_is_nan_and_the_rest_goes_on() -> None:
    covariance = np.array([np.ones((2, 2)), np.diag([1.0, -1.0]), np.diag([1e-9, 4.0]), np.eye(2)])
    nees = normalized_error_squared(np.array([[1.0, 2.0]]), covariance)
    np.testing.assert_allclose(nees, [np.nan, np.nan, 1e9 + 1.0, 5.0])
    assert np.isnan(normalized_error_squared(np.empty((1, 0)), np.empty((1, 0, 0)))).all()


def test_the_nees_of_leading_components_is_that_of_their_block() -> None:
    """To the last bit, also if the whole covariance is singular."""
    rng = np.random.default_rng(4)
    factor, error = rng.normal(size=(50, 4, 4)), rng.normal(size=(50, 4))
    covariance = factor @ factor.swapaxes(1, 2)
    covariance[0, 3], covariance[0, :, 3] = covariance[0, 2], covariance[0, :, 2]
    covariance[1, 1, 1] = np.inf
    whole, leading = errors_squared(error, covariance, 2)
    assert np.isnan(whole[0])
    block = covariance[:, :2, :2]
    np.testing.assert_array_equal(whole, normalized_error_squared(error, covariance))
    np.testing.assert_array_equal(leading, normalized_error_squared(error[:, :2], block))


def test_ellipse_area() -> None:
    """95 % of a plane Gaussian lie within pi * 5.9915 * sqrt(det)."""
    assert ellipse_area(np.diag([4.0, 9.0])) == pytest.approx(np.pi * 5.991464547 * 6.0)


def test_a_singular_ellipse_has_no_area() -> None:
    """Two errors span a line; rounding can make the determinant of their covariance negative."""
    error = np.random.default_rng(0).normal(size=(100, 2))
    singular = error[:, :, None] * error[:, None, :]
    assert (np.linalg.det(singular) < 0).any()
    np.testing.assert_allclose(ellipse_area(singular), 0.0, atol=1e-6)


def test_dilution_of_precision() -> None:
    """Eq (32): an error of range times total noise has dilution one."""
    assert dilution_of_precision(5.0, 1000.0, np.array([3e-3, 4e-3])) == pytest.approx(1.0)
