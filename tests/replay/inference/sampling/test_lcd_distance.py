"""The LCD distance against the sheet's exact values and the paper's integrals, done by brute force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling import lcd_distance
from fuselog.replay.inference.sampling.distance import B_MAX, lcd_distance_and_gradient
from fuselog.replay.inference.sampling.samplers import rotated, unscented


def printed_distance(points, weights):
    """D / pi^(N/2) as the integral over b of the print's P1 - 2 P2 + P3; takes complex points too."""
    dimension = points.shape[1]
    nodes, node_weights = np.polynomial.legendre.leggauss(30)
    edges = np.concatenate([[0], B_MAX / 2.0 ** np.arange(20, -1, -1)])
    halves = np.diff(edges) / 2
    b = (edges[:-1, None] + halves[:, None] * (nodes + 1)).ravel()
    db = (halves[:, None] * node_weights).ravel()
    between = ((points[:, None] - points) ** 2).sum(-1)
    wide = 1 + 2 * b**2
    p1 = b ** (dimension + 1) / (1 + b**2) ** (dimension / 2)
    p2 = 2 ** (dimension / 2) * b ** (dimension + 1) / wide ** (dimension / 2)
    p2 = p2 * (weights @ np.exp(-(points**2).sum(-1)[:, None] / (2 * wide)))
    p3 = b * np.einsum("i,j,ijb->b", weights, weights, np.exp(-between[..., None] / (4 * b**2)))
    return db @ (p1 - 2 * p2 + p3)


def random_set(dimension, count, scale, seed):
    """Points of any spread, with weights that sum to 1, some of them negative."""
    generator = np.random.default_rng(seed)
    weights = generator.normal(1, 1, count)
    return scale * generator.standard_normal((count, dimension)), weights / weights.sum()


@pytest.mark.parametrize(("dimension", "expected"), [(2, 47.6924397416), (8, 42.9068205305)])
def test_a_sample_far_away_leaves_D1(dimension, expected):
    """D2 vanishes and D3 is B^2 / 2: wrong nodes or a wrong constant would show."""
    far_away = np.full((1, dimension), 1e9)
    assert lcd_distance(far_away) - B_MAX**2 / 2 == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("dimension", "pair", "unscented_set"),
    [(2, 0.133619467174, 0.025148085681), (8, 0.901520275854, 0.040248722186)],
)
def test_distances_of_known_sets(dimension, pair, unscented_set):
    """The sheet's values for {+e1, -e1} and for the equally weighted unscented set."""
    axis = np.eye(dimension)[:1]
    assert lcd_distance(np.concatenate([axis, -axis])) == pytest.approx(pair, abs=1e-9)
    assert lcd_distance(*unscented(dimension)) == pytest.approx(unscented_set, abs=1e-9)


@pytest.mark.paper
@pytest.mark.parametrize("scale", [0.1, 1.0, 15.0])
@pytest.mark.parametrize("dimension", [1, 3, 8])
def test_distance_and_gradient_are_those_of_the_printed_integrals(dimension, scale):
    """Scale 15 has pairs beyond u = 1, where E1 is a continued fraction.

    The gradient is a complex step through the integrals over b, which have no E1 in the way; of each
    point by some of its coordinates.
    """
    points, weights = random_set(dimension, 9, scale, seed=dimension)
    distance, gradient = lcd_distance_and_gradient(points, weights)
    assert distance == pytest.approx(printed_distance(points, weights), abs=1e-11)
    for place in (each for each in np.ndindex(points.shape) if sum(each) % 3 == 0):
        stepped = points.astype(complex)
        stepped[place] += 1e-30j
        slope = printed_distance(stepped, weights).imag / 1e-30
        assert gradient[place] == pytest.approx(slope, rel=1e-10, abs=1e-12)


@given(st.integers(1, 6), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_distance_does_not_see_rotation_or_order(dimension, count, seed):
    """N(0, I) has no preferred direction, and a set no first sample."""
    generator = np.random.default_rng(seed)
    points = generator.standard_normal((count, dimension))
    turned, _ = rotated(unscented(dimension)._replace(points=points), generator)
    expected = pytest.approx(lcd_distance(points), rel=1e-11, abs=1e-12)
    assert lcd_distance(turned) == expected
    assert lcd_distance(generator.permutation(points)) == expected


def test_samples_on_one_spot_count_as_one():
    """Splitting a sample's weight changes nothing, and the logarithm at distance zero does no harm."""
    points, weights = random_set(3, 4, 1.0, seed=0)
    whole = lcd_distance(points, weights)
    split, gradient = lcd_distance_and_gradient(np.repeat(points, 2, 0), np.repeat(weights, 2) / 2)
    assert split == pytest.approx(whole, abs=1e-12)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(
    ("points", "weights"),
    [
        (np.zeros(3), None),
        (np.zeros((0, 2)), None),
        (np.full((2, 2), np.nan), None),
        (np.zeros((2, 2)), np.ones(3) / 3),
        (np.zeros((2, 2)), np.ones(2)),
        (np.zeros((2, 2)), np.full(2, np.nan)),
    ],
)
def test_bad_sets_are_refused(points, weights):
    with pytest.raises(BadInput):
        lcd_distance(points, weights)
