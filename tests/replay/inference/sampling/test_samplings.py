"""The family of samplings: exact moments, known sets, randomness without bias, and names."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling import lcd_distance, parse_sampling
from fuselog.replay.inference.sampling.samplers import (
    Samples,
    axis_points,
    randomised_unscented,
    rotated,
    unscented,
)

NAMES = ["ukf", "ukf:kappa=-0.5", "gf-2", "gf-25", "rukf-3", "s2kf-25", "s2kf-50:symmetric:rotation=4"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dimension", [1, 2, 5])
def test_every_sampling_has_the_moments_of_a_standard_normal(name, dimension):
    """Mean 0, covariance I and total weight 1 in every draw, and the shapes that were promised."""
    sampler = parse_sampling(name).at(dimension)
    points, weights = sampler.draw(np.random.default_rng(1), (3, 2))
    assert points.shape == (3, 2, sampler.count, dimension)
    assert weights.shape == points.shape[:-1]
    assert weights.sum(-1) == pytest.approx(np.ones((3, 2)))
    assert np.einsum("...l,...li->...i", weights, points) == pytest.approx(np.zeros((3, 2, dimension)))
    second = np.einsum("...l,...li,...lj->...ij", weights, points, points)
    assert second == pytest.approx(np.broadcast_to(np.eye(dimension), second.shape), abs=1e-12)
    assert sampler.redrawn == (not np.array_equal(points[0], points[1]))


def test_known_sets():
    """Weights of the unscented transform; the axis points of 2 and 3 are cubature and unscented."""
    assert unscented(3).weights == pytest.approx(np.full(7, 1 / 7))
    assert unscented(3, 1.0).weights == pytest.approx([1 / 4] + [1 / 8] * 6)
    assert np.linalg.norm(unscented(3, 1.0).points, axis=1) == pytest.approx([0] + [2] * 6)
    assert lcd_distance(*axis_points(3, 3)) == pytest.approx(lcd_distance(*unscented(3)), rel=1e-12)
    assert np.linalg.norm(axis_points(3, 3).points, axis=1) == pytest.approx([0] + [np.sqrt(3.5)] * 6)
    assert np.linalg.norm(axis_points(3, 2).points, axis=1) == pytest.approx(np.full(6, np.sqrt(3)))


def test_axis_points_halve_slices_of_equal_probability():
    """Up to one common scale, Phi(x_i) = (2i - 1) / (2D) on each axis."""
    points, _ = axis_points(2, 5)
    line = np.sort(points[points[:, 1] == 0, 0])
    quantiles = norm.ppf([0.1, 0.3, 0.5, 0.7, 0.9])
    assert len(points) == 2 * 4 + 1
    assert line / line[-1] == pytest.approx(quantiles / quantiles[-1])


def test_randomised_sets_integrate_without_bias():
    """Fourth moments and a bounded function, which no single unscented set integrates, within 4 sigma.

    A wrong distribution of the radius or of the rotation would show in E x^4 = 3 or E x^2 y^2 = 1.
    """
    points, weights = randomised_unscented(3, 2, np.random.default_rng(5), (20000,))
    x, y = points[..., 0], points[..., 1]
    for values, exact in [(x**4, 3), (x**2 * y**2, 1), (np.cos(2 * x + y), np.exp(-2.5))]:
        draws = np.sum(weights * values, axis=-1)
        assert abs(draws.mean() - exact) < 4 * draws.std() / np.sqrt(len(draws))
    assert (weights[:, 0] < 0).any()


def test_rotations_have_no_preferred_direction():
    """LAPACK's Q alone is not uniform: the mean of its entries is off zero by 0.3 and more."""
    generator = np.random.default_rng(2)
    corner = Samples(np.eye(3), np.full(3, 1 / 3))
    turned = np.array([rotated(corner, generator).points for _ in range(4000)])
    assert np.abs(turned.mean(axis=0)).max() < 4 * np.sqrt(1 / 3 / 4000)
    assert (turned**2).mean(axis=0) == pytest.approx(np.full((3, 3), 1 / 3), abs=0.03)


def test_a_log_may_be_cut_into_blocks_anywhere():
    """Draws one after the other equal draws at once, bit for bit."""
    draw = parse_sampling("rukf-2").at(2).draw
    whole, pieces = np.random.default_rng(9), np.random.default_rng(9)
    at_once = draw(whole, (12,))
    parts = [draw(pieces, (5,)), draw(pieces, (7,))]
    for together, split in zip(at_once, zip(*parts, strict=True), strict=True):
        assert np.array_equal(together, np.concatenate(split))


def test_a_fixed_set_is_shared_and_read_only():
    """A million steps take no more memory than one, and no filter can spoil the set of another."""
    points, _ = parse_sampling("ukf").at(2).draw(np.random.default_rng(0), (10**6,))
    assert points.strides[0] == 0
    assert not points.flags.writeable


@given(st.integers(1, 999), st.booleans(), st.integers(0, 99), st.integers(0, 99))
def test_a_sampling_prints_the_name_it_came_from(count, symmetric, seed, rotation):
    """Result tables and caches name a sampling by what `parse_sampling` understands."""
    options = [f"seed={seed}"] * (seed > 0) + [f"rotation={rotation}"] * (rotation > 0)
    name = ":".join([f"s2kf-{count}", *["symmetric"] * symmetric, *options])
    assert str(parse_sampling(name)) == name


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("", "is not a sampling"),
        ("lcd-50", "is not a sampling"),
        ("s2kf--5", "is not a sampling"),
        ("s2kf-50:", "is not a sampling"),
        ("ukf-3", "number: is not known"),
        ("s2kf", "count: is missing"),
        ("s2kf-0", "count: .*greater than 0"),
        ("s2kf-50:sed=3", "sed: is not known; s2kf takes count, symmetric, seed, rotation"),
        ("s2kf-50:seed=1:seed=2", "twice"),
        ("s2kf-50:seed=-1", "seed: .*greater than or equal to 0"),
        ("gf-1", "per_axis: .*greater than or equal to 2"),
        ("ukf:kappa=nan", "kappa: .*finite"),
        ("ukf:kappa", "kappa: .*number"),
    ],
)
def test_bad_names_are_refused_in_one_sentence(name, reason):
    with pytest.raises(BadInput, match=reason) as refusal:
        parse_sampling(name)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "dimension", "reason"),
    [
        ("gf-3", 0, "dimension of 1 or more"),
        ("s2kf-50", -2, "dimension of 1 or more"),
        ("ukf:kappa=-2", 2, "give a value above -2"),
        ("s2kf-8", 8, "give 9 or more"),
        ("s2kf-15:symmetric", 8, "give 16 or more"),
    ],
)
def test_dimensions_that_a_sampling_cannot_serve(name, dimension, reason):
    with pytest.raises(BadInput, match=reason):
        parse_sampling(name).at(dimension)
