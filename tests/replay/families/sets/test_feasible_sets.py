"""Exact sets and pseudo-ellipsoids against the set-membership sheet, and against point-wise tests."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.sets.models import relative_bearing
from fuselog.replay.families.sets.regions.feasible_sets import (
    Arena,
    area,
    box,
    discs,
    evaluate,
    exact_set,
    excess_rad,
    half_planes,
    intersection,
    make_pairs,
    rings,
    signed_area,
    to_blame,
)
from fuselog.replay.families.sets.regions.pseudo_ellipsoids import (
    PseudoEllipsoid,
    fit,
    fuse,
    measurement,
    most_room,
    outline,
    ring_coefficients,
    room,
    slack,
)

pytestmark = pytest.mark.paper

ARENA = Arena(np.array([-5.0, -5.0]), np.array([5.0, 5.0]))
LANDMARKS = np.array([[0.0, 1.0], [1.0, 1.0], [-1.0, 0.0]])


def section_v(first=(2, 0, 1), second=(0, 1, 2), bound_deg=4.0):
    """The paper's example: robot (0, 0), noise-free pairs (3,1), (1,2), (2,3)."""
    one, two = LANDMARKS[list(first)], LANDMARKS[list(second)]
    return make_pairs(one, two, relative_bearing((0.0, 0.0), one.T, two.T), np.radians(bound_deg))


def bounding_ellipsoid_update(centre, shape, rows, value, size, weight):
    """The bounding ellipsoid filter (6), (7) as printed: its centre, C^+ and s."""
    spread = size + weight * rows @ shape @ rows.T
    gain = weight * np.linalg.solve(spread, rows @ shape).T
    error = value - rows @ centre
    factor = 1.0 + weight - weight * error @ np.linalg.solve(spread, error)
    return centre + gain @ error, factor * (shape - gain @ rows @ shape), factor


def box_area(border):
    low, high = box(border)
    return np.prod(high - low)


def scene(seed, landmarks, bound_rad, error):
    """A random robot among random landmarks; every angle wrong by `error` times the bound at most."""
    rng = np.random.default_rng(seed)
    places, robot = rng.uniform(-3, 3, (landmarks, 2)), rng.uniform(-4, 4, 2)
    first, second = (places[index] for index in np.triu_indices(landmarks, 1))
    noise = rng.uniform(-error, error, len(first)) * bound_rad
    return robot, make_pairs(
        first, second, relative_bearing(robot, first.T, second.T) + noise, bound_rad
    )


def test_the_sheets_angles():
    np.testing.assert_allclose(np.degrees(section_v().angle_rad), [90, 45, -135], atol=1e-9)


def test_a_circle_is_not_cut_by_itself():
    """Alone it is in two halves, whatever rounding leaves of its own equation along it."""
    rng, planes = np.random.default_rng(1), half_planes(ARENA)
    for radius, *centre in rng.uniform([0.5, -2.0, -2.0], [2.0, 2.0, 2.0], (50, 3)):
        disc = np.array([1.0, *np.multiply(-2.0, centre), np.dot(centre, centre) - radius**2])
        border = intersection(np.array([disc / (2.0 * radius), *planes]), ARENA)
        np.testing.assert_allclose(border.length, [np.pi * radius] * 2)


def test_exact_sets_of_section_v():
    lune, final = exact_set(section_v((2,), (0,)), ARENA), exact_set(section_v(), ARENA)
    assert area(lune) == pytest.approx(0.14008, rel=5e-3)
    assert box_area(lune) == pytest.approx(1.540, rel=5e-3)
    assert area(final) == pytest.approx(0.01464, rel=3e-3)
    assert box_area(final) == pytest.approx(0.02904, rel=1e-2)


@pytest.mark.parametrize(
    ("order", "weighting", "sweeps", "low", "high"),
    [
        (4, "area", 1, 0.0306 * 0.97, 0.0312 * 1.03),
        (8, "area", 1, 0.0196 * 0.97, 0.0198 * 1.03),
        (4, "area", 10, 0.0299 * 0.98, 0.0299 * 1.02),
        (4, "batch", 1, 0.0295 * 0.98, 0.0295 * 1.02),
        (8, "batch", 1, 0.0194 * 0.98, 0.0194 * 1.02),
        (4, "determinant", 1, 0.040 * 0.97, 0.043 * 1.03),
        (8, "determinant", 1, 0.0231 * 0.97, 0.0233 * 1.03),
    ],
)
def test_pseudo_ellipsoids_of_section_v(order, weighting, sweeps, low, high):
    assert low < outline(fit(section_v(), ARENA, order, weighting, sweeps), ARENA).area_m2 < high


@pytest.mark.parametrize(("order", "expected"), [(4, 0.188), (8, 0.151)])
def test_the_first_pair_of_section_v(order, expected):
    found = outline(fit(section_v((2,), (0,)), ARENA, order), ARENA).area_m2
    assert found == pytest.approx(expected, rel=0.02)


@given(st.integers(0, 2**32), st.integers(2, 5), st.floats(0.005, 1.5))
@settings(max_examples=12)
def test_the_exact_set_is_where_no_bound_is_exceeded(seed, landmarks, bound_rad):
    """Area, box and rings of the arcs against a grid of point-wise tests; the robot is in the set."""
    robot, pairs = scene(seed, landmarks, bound_rad, 1.0)
    assert np.nanmax(excess_rad(pairs, robot)) <= 1e-9
    border = exact_set(pairs, ARENA)
    low, high = box(border)
    assert np.all((low - 1e-9 <= robot) & (robot <= high + 1e-9))
    steps = (high - low) / 200
    axes = [a + step * (0.5 + np.arange(200)) for a, step in zip(low, steps, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)
    inside = np.all(~(excess_rad(pairs, grid) > 0), axis=-1)
    inside &= np.all((grid >= ARENA.low) & (grid <= ARENA.high), axis=-1)
    assert np.all((grid[inside] >= low - 1e-9) & (grid[inside] <= high + 1e-9))
    cell = np.prod(steps)
    # cells that the border cuts are counted in or out
    error = 0.3 * steps.max() * border.length.sum() + 1e-9
    assert area(border) == pytest.approx(inside.sum() * cell, abs=error)
    around = sum(map(signed_area, rings(border, 1e-3)))
    assert area(border) * (1 - 1e-9) - 1e-9 <= around <= area(border) * (1 + 1e-3) + 1e-9


@given(
    st.integers(0, 2**32),
    st.integers(2, 4),
    st.floats(0.005, 1.5),
    st.sampled_from([4, 8]),
    st.sampled_from(["equal", "determinant"]),
)
@example(0, 2, 0.005, 8, "determinant")
@example(1, 4, 0.005, 8, "determinant")
@settings(max_examples=20)
def test_a_pseudo_ellipsoid_holds_the_exact_set(seed, landmarks, bound_rad, order, weighting):
    """Containment, which is what the method guarantees: bounded, unbounded and lens-shaped pairs."""
    _, pairs = scene(seed, landmarks, bound_rad, 1.0)
    fused = fit(pairs, ARENA, order, weighting)
    border = exact_set(pairs, ARENA)
    low, high = box(border)
    axes = [np.linspace(a, b, 120) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid, border.start, *rings(border)])
    inside = np.all(~(excess_rad(pairs, points) > -1e-12), axis=-1)
    scale = np.abs(room(fused, points)).max() + np.abs(fused.constant)
    assert room(fused, points)[inside].min(initial=0.0) >= -1e-9 * scale


@pytest.mark.parametrize("angle_deg", [0.0, 4.0, -4.0, 176.0, 180.0, -176.0])
def test_straight_lines_are_half_planes(angle_deg):
    """At g = 0 and g = pi the circles are lines; the set is still the point-wise one."""
    pairs = make_pairs([[1.0, 0.0]], [[-1.0, 0.0]], [np.radians(angle_deg)], np.radians(4))
    axes = np.linspace(-4.99, 4.99, 400)
    grid = np.stack(np.meshgrid(axes, axes), axis=-1)
    inside = np.all(excess_rad(pairs, grid) <= 0, axis=-1)
    border = exact_set(pairs, ARENA)
    assert area(border) == pytest.approx(inside.sum() * (axes[1] - axes[0]) ** 2, rel=0.02, abs=0.02)
    for order in (4, 8):
        fused = fit(pairs, ARENA, order, "equal")
        assert room(fused, grid)[inside].min() > -1e-9


def test_the_recursion_is_the_literal_filter_and_the_sum_of_slacks():
    """(7) from a proper prior, the information form, and the closed-form slacks are one set."""
    rng = np.random.default_rng(3)
    pairs = section_v()
    for order in (4, 8):
        centre, shape = rng.normal(size=order), 50 * np.eye(order)
        information = np.linalg.inv(shape)
        prior = PseudoEllipsoid(
            information, information @ centre, centre @ information @ centre - 1, np.zeros(2), 1.0
        )
        points = rng.uniform(-1, 1, (50, 2))
        ring = ring_coefficients(pairs, ARENA)[0]
        fused = fuse(prior, ring, 0.7)
        np.testing.assert_allclose(
            room(fused, points), room(prior, points) + 0.7 * slack(ring, points, order), rtol=1e-9
        )
        moved, spread, size = bounding_ellipsoid_update(centre, shape, *measurement(ring, order), 0.7)
        assert most_room(fused) == pytest.approx(size, rel=1e-6)
        np.testing.assert_allclose(fused.information @ moved, fused.vector, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(np.linalg.inv(spread) * size, fused.information, rtol=1e-6, atol=1e-6)


def test_an_empty_set_names_the_pair_to_blame():
    """A misidentified landmark: one of three angles is off by 40 degrees."""
    robot, pairs = scene(5, 4, np.radians(2), 0.5)
    assert len(to_blame(pairs, ARENA)) == 0
    angles = pairs.angle_rad.copy()
    angles[3] += np.radians(40)
    wrong = make_pairs(pairs.first, pairs.second, angles, pairs.bound_rad)
    assert len(exact_set(wrong, ARENA).length) == 0
    assert to_blame(wrong, ARENA)[0] == 3
    assert np.nanmax(np.delete(excess_rad(wrong, robot), 3)) <= 0


def test_inconsistent_sets_are_refused_by_the_filter():
    """Section V with the third angle 60 degrees wrong: s < 0 in (7), and nothing left on the plane."""
    right = section_v(bound_deg=1.0)
    pairs = right._replace(angle_rad=right.angle_rad + np.radians([0, 0, 60]))
    for weighting in ("equal", "determinant"):
        with pytest.raises(BadInput, match="no common point"):
            fit(pairs, ARENA, 8, weighting)
    assert outline(fit(pairs, ARENA, 8, "area"), ARENA).rings == []
    assert list(to_blame(pairs, ARENA)) == [2]
    with pytest.raises(BadInput, match="empty"):
        box(exact_set(pairs, ARENA))


@pytest.mark.parametrize(
    ("second", "angle", "bound", "said"),
    [
        ([[1.0, 0.0]], [0.5], 0.1, "at the same position"),
        ([[0.0, 0.0]], [0.5], 0.0, "bound"),
        ([[0.0, 0.0]], [0.5], np.pi, "bound"),
        ([[0.0, 0.0]], [np.nan], 0.1, "finite"),
        ([[0.0, 0.0]], [0.5, 0.5], 0.1, "one of each"),
    ],
)
def test_bad_input(second, angle, bound, said):
    with pytest.raises(BadInput, match=said):
        make_pairs([[1.0, 0.0]], second, angle, bound)


def test_constraints_measure_distance_near_their_border():
    """The scale of the tolerances: |gradient| = 1 on every circle and line."""
    _, pairs = scene(1, 4, 0.1, 1.0)
    border = exact_set(pairs, ARENA)
    outward = np.stack([np.sin(border.heading_rad), -np.cos(border.heading_rad)], axis=1)
    constraints = np.concatenate([discs(pairs).reshape(-1, 4), half_planes(ARENA)])
    step = 1e-6 * outward
    change = evaluate(constraints, border.start + step) - evaluate(constraints, border.start - step)
    assert np.isclose(change / 2e-6, 1.0, atol=1e-4).any(axis=1).all()
