"""Mixtures on the torus: densities that integrate to one, known special cases, samples fitted back."""

import numpy as np
import pytest
from scipy.stats import vonmises

from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.families.directional.distributions import wrapped_normal
from fuselog.replay.families.directional.distributions.torus_mixtures import (
    VonMisesMixture,
    WrappedMixture,
    fit_von_mises_mixture,
    fit_wrapped_mixture,
)
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from fuselog.replay.families.directional.grid import torus_grid

WEIGHTS, MEANS = np.array([0.3, 0.7]), np.array([[3.0, 2.0], [-1.0, 3.1]])
COVARIANCES = np.array([[[0.5, 0.2], [0.2, 0.3]], [[0.1, -0.05], [-0.05, 0.2]]])
CONCENTRATIONS = np.array([[3.0, 2.0, 1.1], [0.5, 4.0, -0.6]])


@pytest.mark.parametrize("interaction", ["sine", "cosine"])
def test_von_mises_densities_integrate_to_one(interaction):
    mixture = VonMisesMixture(WEIGHTS, MEANS, CONCENTRATIONS, interaction)
    density = np.exp(mixture.log_density(torus_grid(200).reshape(-1, 2)))
    assert density.mean() * (2.0 * np.pi) ** 2 == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("interaction", ["sine", "cosine"])
def test_without_interaction_the_angles_are_independent(interaction):
    """Then each is von Mises distributed, as SciPy has it."""
    one = VonMisesMixture(np.ones(1), MEANS[:1], np.array([[3.0, 2.0, 0.0]]), interaction)
    angles = np.array([[0.1, 3.0], [-2.0, 1.0], [3.1, -3.1]])
    expected = vonmises(3.0, MEANS[0, 0]).logpdf(angles[:, 0]) + vonmises(2.0, MEANS[0, 1]).logpdf(
        angles[:, 1]
    )
    np.testing.assert_allclose(one.log_density(angles), expected, rtol=1e-12)


def test_wrapped_mixture_has_the_density_of_its_parts():
    angles = torus_grid(20).reshape(-1, 2)
    parts = wrapped_normal.density(WrappedNormal(MEANS, COVARIANCES), angles[:, None])
    found = WrappedMixture(WEIGHTS, MEANS, COVARIANCES).log_density(angles)
    np.testing.assert_allclose(np.exp(found), parts @ WEIGHTS, rtol=1e-6, atol=1e-12)


@pytest.mark.paper
def test_samples_are_fitted_back():
    """Parameters within five standard errors or so; other densities come to one optimum."""
    generator = np.random.default_rng(5)
    counts = (1200, 2800)
    angles = np.concatenate(
        [
            wrapped_normal.sample(WrappedNormal(mean, covariance), count, generator)
            for mean, covariance, count in zip(MEANS, COVARIANCES, counts, strict=True)
        ]
    )
    fit = fit_wrapped_mixture(angles, 2)
    order = np.argsort(fit.weights)
    assert fit.weights[order] == pytest.approx(WEIGHTS, abs=0.01)
    np.testing.assert_allclose(wrap_angle(fit.mean[order] - MEANS), 0.0, atol=0.06)
    np.testing.assert_allclose(fit.covariance[order], COVARIANCES, atol=0.06)
    true = WrappedMixture(WEIGHTS, MEANS, COVARIANCES).log_density(angles).sum()
    likelihood = fit.log_density(angles).sum()
    assert 0.0 < likelihood - true < 20.0  # twice that is chi-square of 11 degrees
    for interaction in ("sine", "cosine"):
        other = fit_von_mises_mixture(angles, interaction, fit)
        near = fit_von_mises_mixture(angles, interaction, fit._replace(mean=fit.mean + 0.1))
        assert other.log_density(angles).sum() == pytest.approx(near.log_density(angles).sum(), abs=0.01)
        assert abs(other.log_density(angles).sum() - likelihood) < 0.03 * len(angles)


def test_maximum_likelihood_is_at_least_as_likely_as_moments():
    generator = np.random.default_rng(1)
    angles = wrapped_normal.sample(WrappedNormal(MEANS[0], COVARIANCES[0]), 300, generator)
    even = wrapped_normal.Samples(angles, np.full(300, 1.0 / 300))
    by_moments = wrapped_normal.fit_moments(wrapped_normal.sample_moments(even))
    one = fit_wrapped_mixture(angles, 1)
    assert one.log_density(angles).sum() >= np.log(wrapped_normal.density(by_moments, angles)).sum()


def test_too_few_angles_are_refused():
    with pytest.raises(BadInput, match="19 pairs of angles for 2 components; give at least 10"):
        fit_wrapped_mixture(np.zeros((19, 2)), 2)
