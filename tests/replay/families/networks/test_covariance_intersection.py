"""Fusion rules against the covariance-intersection sheet, their certificates and what they guarantee."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.networks.covariance_intersection import RULES, fuse
from fuselog.replay.families.networks.nodes import observe
from fuselog.replay.families.networks.pairwise import Stake, sighting_weight

PAIR = np.array([np.diag([1.0, 4.0]), [[3.0, 1.0], [1.0, 1.0]]])
THREE = np.array([np.diag([1.0, 4.0]), np.diag([4.0, 1.0]), [[2.0, 1.5], [1.5, 2.0]]])
ORIGIN = np.zeros(2)


def positive(rng, *shape, size=3):
    factor = rng.normal(size=(*shape, size, size))
    return factor @ np.swapaxes(factor, -1, -2) + 0.05 * np.eye(size)


@pytest.mark.parametrize(
    ("name", "weight", "quantity", "value"),
    [
        ("ci-trace", 0.51378, np.trace, 2.736076),
        ("ci-determinant", 0.357143, np.linalg.det, 1.635036),
        ("niehsen", 4 / 9, None, None),
        ("franken", 0.447368, None, None),
    ],
)
def test_two_estimates(name, weight, quantity, value):
    fused = fuse(name, [ORIGIN, ORIGIN], PAIR)
    assert fused.weights[0] == pytest.approx(weight, rel=1e-4)
    if quantity is not None:
        assert quantity(fused.covariance) == pytest.approx(value, rel=1e-4)


def test_inverse_covariance_intersection():
    fused = fuse("inverse-ci", [ORIGIN, ORIGIN], PAIR)
    assert fused.weights[1] == pytest.approx(0.3797, rel=1e-4)
    assert np.trace(fused.covariance) == pytest.approx(1.995227, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "weights", "quantity", "value"),
    [
        ("ci-trace", (0.34616, 0.34616, 0.30767), np.trace, 2.874973),
        ("ci-determinant", (0.15311, 0.15311, 0.69378), np.linalg.det, 1.625556),
    ],
)
def test_three_estimates(name, weights, quantity, value):
    fused = fuse(name, np.zeros((3, 2)), THREE)
    np.testing.assert_allclose(fused.weights, weights, rtol=1e-4)
    assert quantity(fused.covariance) == pytest.approx(value, rel=1e-4)


@pytest.mark.paper
@given(st.integers(0, 2**32), st.integers(2, 5), st.sampled_from(["ci-trace", "ci-determinant"]))
@settings(max_examples=25, deadline=None)
def test_the_certificate_bounds_what_other_weights_gain(seed, count, name):
    rng = np.random.default_rng(seed)
    covariances = positive(rng, count)
    fused = fuse(name, np.zeros((count, 3)), covariances, tolerance=1e-6)
    others = rng.dirichlet(np.ones(count), 200)
    information = np.einsum("wk,kij->wij", others, np.linalg.inv(covariances))
    found = np.linalg.inv(information)
    if name == "ci-trace":
        best, least = np.trace(fused.covariance), np.trace(found, axis1=1, axis2=2).min()
    else:
        best = np.linalg.det(fused.covariance) ** (1 / 3)
        least = np.linalg.det(found).min() ** (1 / 3)
    assert best <= least * (1 + 1e-5)


@given(st.integers(0, 2**32), st.sampled_from(["ci-trace", "ci-determinant", "niehsen", "franken"]))
@settings(max_examples=25, deadline=None)
def test_ci_is_conservative_for_any_correlation(seed, name):
    """The true covariance of the fused error never exceeds the stated one, whatever P_ab is."""
    rng = np.random.default_rng(seed)
    joint = positive(rng, size=6)
    stated = np.stack([joint[:3, :3], joint[3:, 3:]])
    fused = fuse(name, np.zeros((2, 3)), stated, tolerance=1e-6)
    gains = [w * fused.covariance @ np.linalg.inv(p) for w, p in zip(fused.weights, stated, strict=True)]
    gain = np.hstack(gains)
    actual = gain @ joint @ gain.T
    assert np.linalg.eigvalsh(fused.covariance - actual)[0] >= -1e-9 * np.trace(actual)


def test_split_ci_is_the_kalman_filter_for_independent_and_ci_for_correlated_parts():
    rng = np.random.default_rng(4)
    means, covariances = rng.normal(size=(2, 3)), positive(rng, 2)
    kalman = fuse("naive", means, covariances)
    split = fuse("split-ci", means, covariances, covariances)
    np.testing.assert_allclose(split.mean, kalman.mean, rtol=1e-6)
    np.testing.assert_allclose(split.covariance, kalman.covariance, rtol=1e-6)
    unknown, known = fuse("split-ci", means, covariances), fuse("ci-trace", means, covariances)
    np.testing.assert_allclose(unknown.covariance, known.covariance, rtol=1e-4)


def test_a_known_common_part_is_not_counted_twice_by_inverse_ci():
    """Errors that share information G: the fused estimate may not claim more than there is."""
    rng = np.random.default_rng(5)
    common, own = np.linalg.inv(positive(rng)), [np.linalg.inv(positive(rng)) for _ in range(2)]
    stated = np.stack([np.linalg.inv(common + each) for each in own])
    fused = fuse("inverse-ci", np.zeros((2, 3)), stated)
    best = np.linalg.inv(common + own[0] + own[1])
    assert np.linalg.eigvalsh(fused.covariance - best)[0] >= -1e-9
    known = fuse("ci-trace", np.zeros((2, 3)), stated)
    # the best weight is at the edge here, where its error of a millionth counts in full
    assert np.trace(fused.covariance) <= np.trace(known.covariance) * (1 + 1e-6)


@pytest.mark.parametrize("name", ["inverse-ci", "ci-trace", "split-ci"])
def test_the_fused_mean_weighs_each_mean_by_what_its_estimate_adds(name):
    """Means away from the origin: information-weighted, with what inverse CI counts as common taken off.

    Noack, Sijs, Reinhardt, Hanebeck, (11): K_i = P (P_i^-1 - w_i (w_a P_a + w_b P_b)^-1).
    """
    means = np.array([[1.0, -2.0], [40.0, 3.0]])
    fused = fuse(name, means, PAIR)
    added, shares = np.linalg.inv(PAIR), fused.weights
    if name != "ci-trace":  # fused one after another: the second weight is that of what was before
        shares = np.array([fused.weights[1], 1.0 - fused.weights[1]])
    if name == "inverse-ci":
        common = np.linalg.inv(np.einsum("i,ijk->jk", shares, PAIR))
        added = added - shares[:, None, None] * common
    else:
        added = shares[:, None, None] * added
    np.testing.assert_allclose(np.linalg.inv(fused.covariance), added.sum(axis=0), rtol=1e-5)
    expected = fused.covariance @ np.einsum("ijk,ik->j", added, means)
    np.testing.assert_allclose(fused.mean, expected, rtol=1e-5)


def test_batches_equal_their_members_and_all_rules_keep_equal_estimates():
    rng = np.random.default_rng(6)
    means, covariances = rng.normal(size=(4, 3, 2)), positive(rng, 4, 3, size=2)
    for name in RULES:
        many = fuse(name, means, covariances)
        one = fuse(name, means[2], covariances[2])
        assert all(np.array_equal(a[2], b) for a, b in zip(many, one, strict=True))
        same = fuse(name, np.repeat(means[:1, :1], 3, 1), np.repeat(covariances[:1, :1], 3, 1))
        np.testing.assert_allclose(same.mean[0], means[0, 0], rtol=1e-9)


def fuse_sighting(mean, covariance, rows, innovation, shared, own, criterion="trace"):
    """A sighting's update with the weight of `sighting_weight`, written as in the textbook.

    Returns mean (n,), covariance (n, n) and the weight.
    """
    x, p, h, v, r, q = map(np.asarray, (mean, covariance, rows, innovation, shared, own))
    spread = h @ p @ h.T
    stake = Stake(len(x), np.trace(p), spread, h @ p @ p @ h.T)
    weight = sighting_weight(criterion == "trace", stake, r, q)
    gain = np.linalg.solve(spread / weight + r / (1 - weight) + q, h @ p / weight).T
    return x + gain @ v, p / weight - gain @ h @ p / weight, weight


@pytest.mark.parametrize("criterion", ["trace", "determinant"])
def test_a_sighting_of_all_of_the_state_fuses_as_ci_does(criterion):
    """All of the state seen without noise: CI. What is not seen keeps its variance / w."""
    rng = np.random.default_rng(7)
    means, covariances = rng.normal(size=(2, 3)), positive(rng, 2)
    whole = fuse(f"ci-{criterion}", means, covariances)
    innovation, exact = means[1] - means[0], np.zeros((3, 3))
    mean, covariance, weight = fuse_sighting(
        means[0], covariances[0], np.eye(3), innovation, covariances[1], exact, criterion
    )
    np.testing.assert_allclose(weight, whole.weights[0], atol=1e-4)
    np.testing.assert_allclose(mean, whole.mean, atol=1e-3)
    np.testing.assert_allclose(covariance, whole.covariance, atol=1e-3)


@pytest.mark.parametrize("criterion", ["trace", "determinant"])
def test_a_sighting_of_part_of_the_state_has_the_best_weight_and_keeps_the_rest(criterion):
    state, seen = np.diag([4.0, 1.0]), np.array([[1.0, 0.0]])
    _, covariance, weight = fuse_sighting([0, 0], state, seen, [1.0], [[0.1]], [[0.1]], criterion)
    assert weight > 0.1
    assert covariance[1, 1] == pytest.approx(1.0 / weight)
    size = {"trace": np.trace, "determinant": np.linalg.det}[criterion]
    for other in np.linspace(0.01, 0.99, 99):
        information = other * np.linalg.inv(state) + seen.T @ seen / (0.1 / (1 - other) + 0.1)
        assert size(covariance) <= size(np.linalg.inv(information)) * (1 + 1e-9)


@pytest.mark.parametrize(
    ("covariances", "said"),
    [
        (np.stack([np.eye(2), np.diag([1.0, 0.0])]), "singular"),
        (np.stack([np.eye(2), [[1.0, 0.999999999999999], [0.999999999999999, 1.0]]]), "singular"),
        (np.stack([np.eye(2), [[1.0, 0.5], [0.0, 1.0]]]), "symmetric"),
        (np.stack([np.eye(2), np.full((2, 2), np.nan)]), "finite"),
        (np.eye(2), "at least one estimate"),
    ],
)
def test_bad_covariances_are_refused(covariances, said):
    with pytest.raises(BadInput, match=said):
        fuse("ci-trace", np.zeros((2, 2)), covariances)


def test_an_independent_part_is_at_most_its_covariance_in_every_direction():
    fuse("split-ci", np.zeros((2, 2)), PAIR, PAIR)
    excess = PAIR + np.array([np.zeros((2, 2)), np.diag([-0.5, 0.01])])
    with pytest.raises(BadInput, match="an independent part exceeds its covariance"):
        fuse("split-ci", np.zeros((2, 2)), PAIR, excess)


@pytest.mark.parametrize("name", RULES)
def test_what_cannot_be_inverted_is_refused_by_every_rule(name):
    with pytest.raises(BadInput, match="numerically singular"):
        fuse(name, np.zeros((2, 2)), 1e-310 * PAIR)


def test_an_unknown_rule_is_refused_with_those_there_are():
    with pytest.raises(BadInput, match="ci-trace"):
        fuse("best", np.zeros((2, 2)), PAIR)


def test_what_is_all_independent_stays_so_in_an_update() -> None:
    """By Joseph's form, of a measurement that lacks a component; against that in matrices."""
    root = np.random.default_rng(4).normal(size=(4, 4))
    covariance, mean = root @ root.T, np.array([1.0, 2.0, 3.0, 4.0])
    value, variance = np.array([1.5, np.nan, 2.0, np.nan]), np.array([0.5, 1.0, 2.0, 1.0])
    rows, noise = np.eye(4)[[0, 2]], np.diag([0.5, 2.0])
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise)
    expected = mean + gain @ (value[[0, 2]] - mean[[0, 2]])
    after = (np.eye(4) - gain @ rows) @ covariance
    found = [mean.copy(), covariance.copy(), covariance.copy()]
    observe(*found, value, variance)
    for have, want in zip(found, (expected, after, after), strict=True):
        np.testing.assert_allclose(have, want, rtol=1e-9, atol=1e-12)
