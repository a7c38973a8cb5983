"""Sums of powers and of products: the sheet's numbers, exact covariances, the square-root update."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.replay.families.vehicles.symmetric_sums import (
    power_sums,
    power_sums_at,
    product_sums,
    product_sums_at,
    raw_power_sums,
    update_root,
)
from fuselog.replay.families.vehicles.vehicles import topology, topology_moments

P = np.array([-3.0, -1.0, 0.0, 2.0, 4.0])
SIGMA = np.sqrt(0.5)
TOLERANCE = 1e-4


def _gauss(order: int = 12) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    return nodes, weights / weights.sum()


def test_power_sums_have_the_sheet_s_means_and_covariance() -> None:
    """A wrong Hermite term or factor entry moves one of these by more than 1e-4."""
    nodes, weights = _gauss()
    noisy = P + SIGMA * nodes[:, None]  # every number with every noise, one number after the other
    powers = noisy[..., None] ** np.arange(1, 6)
    raw = np.einsum("k,kna->a", weights, powers)
    assert_allclose(raw, [2, 32.5, 47, 447.75, 1039.5], atol=TOLERANCE)
    pseudo = power_sums_at(P, SIGMA)
    assert_allclose(pseudo.expected, [2, 30, 44, 354, 812], atol=TOLERANCE)
    covariance = pseudo.factor @ pseudo.factor.T
    assert_allclose(
        np.diagonal(covariance), [2.5, 62.5, 1731.75, 45859.5, 1176618.75], rtol=1e-9, atol=TOLERANCE
    )
    assert_allclose(covariance[[0, 0, 3], [1, 2, 4]], [2, 45, 168935], atol=TOLERANCE)


def test_power_sums_are_unbiased_with_the_factor_s_covariance() -> None:
    """Exact moments of two noisy numbers by Gauss-Hermite quadrature; no formula of ours in between."""
    nodes, weights = _gauss()
    grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.outer(weights, weights).ravel()
    p = np.array([1.5, -0.7])
    sums = power_sums(p + SIGMA * grid, SIGMA)
    pseudo = power_sums_at(p, SIGMA)
    assert_allclose(weight @ sums, pseudo.expected, atol=1e-10)
    spread = sums - pseudo.expected
    assert_allclose((weight[:, None] * spread).T @ spread, pseudo.factor @ pseudo.factor.T, atol=1e-9)


def test_product_sums_have_the_sheet_s_numbers() -> None:
    """Sums of products of the sheet's five numbers and the diagonal of their covariance."""
    pseudo = product_sums_at(P, SIGMA)
    assert_allclose(pseudo.expected, [2, -13, -14, 24, 0], atol=TOLERANCE)
    assert_allclose(
        np.sum(pseudo.factor**2, axis=1), [2.5, 23.5, 260.25, 662.8125, 529.03125], atol=TOLERANCE
    )
    assert_allclose(product_sums(P), pseudo.expected, atol=1e-12)


@pytest.mark.paper
@pytest.mark.parametrize("kind", ["powers", "products", "complex"])
def test_covariance_equals_monte_carlo(kind: str) -> None:
    """W W' against the covariance of many draws; 5 standard errors of each entry."""
    rng = np.random.default_rng(3)
    draws = 100_000
    p = P[:4] * (1 + (0.3j if kind == "complex" else 0)) + (1j if kind == "complex" else 0)
    noise = SIGMA * rng.normal(size=(draws, 4))
    if kind == "complex":
        noise = noise + 1j * SIGMA * rng.normal(size=(draws, 4))
    measure, at = {
        "products": (product_sums, product_sums_at),
    }.get(kind, (lambda m: power_sums(m, SIGMA), power_sums_at))
    pseudo = at(p, SIGMA)
    spread = measure(p + noise) - pseudo.expected
    terms = spread[:, :, None] * spread[:, None, :].conj()
    error = terms.std(axis=0) / np.sqrt(draws)
    assert np.all(np.abs(spread.mean(axis=0)) < 5 * spread.std(axis=0) / np.sqrt(draws))
    expected = pseudo.factor @ pseudo.factor.conj().T
    assert np.all(np.abs(terms.mean(axis=0) - expected) < 5 * error)


def test_jacobians_are_derivatives() -> None:
    """Finite differences of the expected sums."""
    step = 1e-6
    for at in (power_sums_at, product_sums_at):
        for column in range(len(P)):
            moved = np.eye(len(P))[column] * step
            slope = (at(P + moved, SIGMA).expected - at(P - moved, SIGMA).expected) / (2 * step)
            assert_allclose(at(P, SIGMA).jacobian[:, column], slope, rtol=1e-6, atol=1e-5)


def test_root_update_equals_kalman_s() -> None:
    """Where R can be formed, the square-root update gives the usual Kalman update."""
    rng = np.random.default_rng(4)
    p = np.array([1.0, -2.0, 0.5])
    pseudo = power_sums_at(p, 0.4)
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    innovation = rng.normal(size=3)
    mean, after = update_root(p, root, pseudo.jacobian @ root, innovation, pseudo.factor)
    covariance, noise = root @ root.T, pseudo.factor @ pseudo.factor.T
    cross = covariance @ pseudo.jacobian.T
    gain = cross @ np.linalg.inv(pseudo.jacobian @ cross + noise)
    assert_allclose(mean, p + gain @ innovation, rtol=1e-9)
    assert_allclose(after @ after.T, covariance - gain @ cross.T, rtol=1e-8, atol=1e-10)


def test_sums_of_equal_multisets_are_equal() -> None:
    """Symmetric functions do not see the order; complex sums tell pairings apart, others do not."""
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(2, 5))
    other = y[[1, 0, 2, 3, 4]]
    order = rng.permutation(5)
    assert_allclose(raw_power_sums(x[order]), raw_power_sums(x))
    assert_allclose(product_sums(x[order]), product_sums(x))
    assert_allclose(raw_power_sums(other), raw_power_sums(y))
    assert np.abs(raw_power_sums(x + 1j * y) - raw_power_sums(x + 1j * other)).max() > 0.1


def test_topology_has_the_sheet_s_numbers() -> None:
    """The nominal vehicles at t = 10, with the infrastructure sensor's noise."""
    start = np.array(
        [[0, -1.5, 100, -1], [0, -1.5, 0, 1], [0, 0, 0, 3], [0, 1.5, 0, 1], [0, 1.5, 100, -1]]
    )
    places = start[:, 0::2] + 10.0 * start[:, 1::2]
    added, variance = topology_moments(places, 0.1)
    assert_allclose(topology(places), 38100.0)
    assert_allclose(topology(places) + added, 38104.0)
    assert_allclose(variance, 76204.0)
    noise = np.sqrt(0.1) * np.random.default_rng(6).normal(size=(200_000, 5, 2))
    drawn = topology(places + noise)
    assert abs(drawn.mean() - 38104.0) < 5 * drawn.std() / np.sqrt(len(drawn))
    assert abs(drawn.var() / 76204.0 - 1.0) < 5 * np.sqrt(2.0 / len(drawn))
