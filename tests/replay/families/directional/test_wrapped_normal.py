"""The wrapped normal on the torus: identities, products against a grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.directional.distributions import wrapped_normal, wrapped_normal_kernels
from fuselog.replay.families.directional.distributions.wrapped_normal import (
    CircularMoments,
    Samples,
    WrappedNormal,
    make_wrapped_normal,
)
from fuselog.replay.families.directional.grid import torus_grid

SIGMA = np.array([0.8, 1.3])


def covariance(rho: float, sigma: np.ndarray = SIGMA) -> np.ndarray:
    return np.outer(sigma, sigma) * np.array([[1.0, rho], [rho, 1.0]])


def trigonometric_moments(distribution, order):
    """E exp(i n x_k) = exp(i n mu_k - n^2 C_kk / 2), (..., 2), (2)."""
    variance = np.diagonal(distribution.covariance, axis1=-2, axis2=-1)
    return np.exp(1j * order * distribution.mean - 0.5 * order**2 * variance)


def spreads(lowest: float, highest: float):
    """Wrapped normals anywhere, with variances between powers of ten and any correlation."""
    power = st.floats(lowest, highest)

    def build(powers, rho, mean):
        return make_wrapped_normal(mean, covariance(rho, 10.0 ** (0.5 * np.array(powers))))

    return st.builds(
        build, st.tuples(power, power), st.floats(-0.99, 0.99), st.tuples(*[st.floats(-3, 3)] * 2)
    )


@settings(deadline=None)
@given(spreads(-6.0, 1.5), st.floats(0.0, 0.45))
def test_five_samples_have_the_moments_of_the_distribution(distribution, central_weight):
    """m_1 and r_c to 1e-12 for every w5; variances of 1e-6 keep their digits too."""
    moments = wrapped_normal.circular_moments(distribution)
    samples = wrapped_normal.five_samples(moments, central_weight)
    assert samples.weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert samples.weights.min() >= 0.0
    first = (samples.weights[:, None] * np.exp(1j * samples.positions)).sum(axis=0)
    expected = trigonometric_moments(distribution, 1)
    np.testing.assert_allclose(first, expected, atol=1e-12)
    found = wrapped_normal.sample_moments(samples)
    assert found.correlation == pytest.approx(float(moments.correlation), abs=1e-12)
    inside = moments.variance < 20.0  # beyond, |m| < 5e-5 and its logarithm loses digits
    np.testing.assert_allclose(found.variance[inside], moments.variance[inside], rtol=1e-9)


@settings(deadline=None)
@given(spreads(-6.0, 1.0))
def test_fit_by_moments_returns_the_distribution(distribution):
    fitted = wrapped_normal.fit_moments(wrapped_normal.circular_moments(distribution))
    scale = np.sqrt(np.prod(np.diagonal(distribution.covariance)))
    np.testing.assert_allclose(
        fitted.covariance, distribution.covariance, rtol=1e-12, atol=1e-12 * scale
    )
    np.testing.assert_allclose(fitted.mean, distribution.mean)


@settings(deadline=None)
@given(spreads(-6.0, 3.0), st.integers(1, 4))
def test_moments_and_correlation_are_those_of_the_density(distribution, order):
    """Closed forms against the closed form of every trigonometric moment, without overflow."""
    c = distribution.covariance
    exact = np.exp(-0.5 * order**2 * np.diagonal(c) + 1j * order * distribution.mean)
    np.testing.assert_allclose(trigonometric_moments(distribution, order), exact)
    found = wrapped_normal.circular_moments(distribution).correlation
    assert abs(found) <= 1.0
    if c.max() < 300.0:
        expected = np.sinh(c[0, 1]) / np.sqrt(np.sinh(c[0, 0]) * np.sinh(c[1, 1]))
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-13)


def test_known_samples():
    distribution = make_wrapped_normal([0.0, 0.0], covariance(0.5))
    moments = wrapped_normal.circular_moments(distribution)
    samples = wrapped_normal.five_samples(moments)
    np.testing.assert_allclose(samples.positions[1], [0.853053, 1.279758], atol=6e-7)
    np.testing.assert_allclose(samples.weights, [0.281241] * 2 + [0.118759] * 2 + [0.2], atol=6e-7)
    assert moments.correlation == pytest.approx(0.406204, abs=6e-7)


def test_mixed_mle_is_no_inverse_of_the_samples():
    """The sheet: rho .5 -> .461 and .9 -> .832 without any motion."""
    for rho, expected in ((0.5, 0.461), (0.9, 0.832)):
        distribution = make_wrapped_normal([1.0, -3.0], covariance(rho))
        samples = wrapped_normal.five_samples(wrapped_normal.circular_moments(distribution))
        fitted = wrapped_normal.fit_mixed_mle(samples).covariance
        assert fitted[0, 1] / SIGMA.prod() == pytest.approx(expected, abs=6e-4)
        np.testing.assert_allclose(np.diagonal(fitted), SIGMA**2, rtol=1e-12)


def test_mixed_mle_approaches_the_truth_with_many_samples():
    """Random samples, unlike the five, are of the density itself."""
    distribution = make_wrapped_normal([0.5, 2.0], covariance(-0.6))
    drawn = wrapped_normal.sample(distribution, 4000, np.random.default_rng(0))
    fitted = wrapped_normal.fit_mixed_mle(Samples(drawn, np.full(4000, 1.0 / 4000)))
    np.testing.assert_allclose(fitted.covariance, distribution.covariance, atol=0.15)
    np.testing.assert_allclose(fitted.mean, distribution.mean, atol=0.1)


def test_density_is_normalised_and_has_its_moments():
    """On both sides of the switch from wrapped to Fourier sums."""
    grid = torus_grid(256)
    cell = (2.0 * np.pi / 256) ** 2
    for scale in (0.05, 0.5, 1.0, 3.0, 30.0, 1e6):
        distribution = make_wrapped_normal([0.3, -2.0], scale * covariance(0.7))
        density = wrapped_normal.density(distribution, grid)
        assert density.sum() * cell == pytest.approx(1.0, abs=1e-12)
        moments = (density[..., None] * np.exp(1j * grid)).sum(axis=(0, 1)) * cell
        expected = trigonometric_moments(distribution, 1)
        np.testing.assert_allclose(moments, expected, atol=1e-12)


def test_density_is_finite_where_it_is_narrow():
    narrow = make_wrapped_normal([3.1, 0.0], 1e-6 * np.eye(2))
    x = np.array([[3.1, 0.0], [3.1 - 2.0 * np.pi, 2.0 * np.pi], [0.0, 0.0]])
    expected = [1e6 / (2.0 * np.pi)] * 2 + [0.0]
    np.testing.assert_allclose(wrapped_normal.density(narrow, x), expected, rtol=1e-9)


@pytest.mark.paper
@settings(deadline=None, max_examples=15)
@given(spreads(-1.5, 1.0), spreads(-1.5, 1.0))
def test_product_is_that_of_the_densities(first, second):
    """Everywhere on a grid to 1e-12 of the peak; and the refit has the moments of this mixture."""
    grid = torus_grid(64)
    expected = wrapped_normal.density(first, grid) * wrapped_normal.density(second, grid)
    expected /= expected.sum()
    mixture = wrapped_normal.product_mixture(first, second)
    density = sum(
        weight * wrapped_normal.density(WrappedNormal(mean, mixture.covariance), grid)
        for mean, weight in zip(mixture.mean, mixture.weights, strict=True)
        if weight > 1e-17
    )
    np.testing.assert_allclose(density / density.sum(), expected, atol=1e-12 * expected.max())
    refitted = wrapped_normal.product(first, second)
    found = trigonometric_moments(refitted, 1)
    moments = mixture.weights @ np.exp(1j * mixture.mean - 0.5 * np.diagonal(mixture.covariance))
    np.testing.assert_allclose(found, moments, atol=1e-12)
    assert np.linalg.eigvalsh(refitted.covariance)[0] > 0.0


def test_product_with_a_uniform_density_changes_nothing():
    known = make_wrapped_normal([1.0, 2.0], [[1e-6, 1e-5], [1e-5, 1e-2]])
    uniform = make_wrapped_normal([0.0, 0.0], 1e6 * np.eye(2))
    for pair in ((known, uniform), (uniform, known)):
        found = wrapped_normal.product(*pair)
        np.testing.assert_allclose(found.mean, known.mean, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, known.covariance, rtol=1e-9)


def test_a_mean_that_vanishes_is_uniform():
    """Four samples around the circle have no direction: the variance that stands for uniform."""
    around = np.stack([np.arange(4) * np.pi / 2.0, np.array([0.0, 0.1, 0.0, -0.1])], axis=-1)
    moments = wrapped_normal.sample_moments(Samples(around, np.full(4, 0.25)))
    assert 70.0 < moments.variance[0] <= wrapped_normal_kernels.UNIFORM


def moments_of(variance: list[float], correlation: float) -> CircularMoments:
    return CircularMoments(np.zeros(2), np.array(variance), np.array(correlation))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_wrapped_normal([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]]), "positive definite"),
        (lambda: make_wrapped_normal([0.0, 0.0], [[1.0, 0.5], [0.4, 1.0]]), "symmetric"),
        (lambda: make_wrapped_normal([np.nan, 0.0], np.eye(2)), "finite"),
        (lambda: make_wrapped_normal([0.0, 0.0, 0.0], np.eye(3)), "expected"),
        (lambda: wrapped_normal.five_samples(moments_of([1.0, 1.0], 0.1), 0.6), "central weight"),
        (lambda: wrapped_normal.five_samples(moments_of([1.0, 1.0], 1.1)), "circular correlation"),
        (lambda: wrapped_normal.fit_moments(moments_of([0.0, 1.0], 0.1)), "not in"),
        (lambda: wrapped_normal.fit_moments(moments_of([np.inf, 1.0], 0.1)), "not in"),
        (lambda: wrapped_normal.fit_moments(moments_of([0.5, 3.0], 0.9)), "fit_mixed_mle"),
    ],
)
def test_bad_input_is_told(make, message):
    with pytest.raises(BadInput, match=message):
        make()
