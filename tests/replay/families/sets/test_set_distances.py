"""OSPA and GOSPA: the sheet's known answers, and what makes a distance a metric."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.sets.judging.distances import gospa, gospa_pairs, ospa

THREE = [(0, 0), (10, 0), (0, 10)]
EMPTY = np.empty((0, 2))
POINTS = st.integers(0, 4).flatmap(
    lambda count: arrays(float, (count, 2), elements=st.floats(-20, 20, width=32))
)


@pytest.mark.parametrize(
    ("estimates", "truths", "ospa_2", "gospa_2"),
    [
        (THREE, [(1, 0), (10, 2), (0, 10)], 1.2909944487, 2.2360679775),
        (THREE, [(0, 0), (10, 0)], 5.7735026919, 7.0710678119),
        ([(0, 0)], [(20, 0)], 10.0, 10.0),
        (EMPTY, EMPTY, 0.0, 0.0),
        (EMPTY, [(1, 1)], 10.0, np.sqrt(50)),
    ],
)
def test_known_answers_of_the_sheet(estimates, truths, ospa_2, gospa_2):
    assert ospa(estimates, truths, 10, 2) == pytest.approx(ospa_2, abs=1e-10)
    assert gospa(estimates, truths, 10, 2).total == pytest.approx(gospa_2, abs=1e-10)


def test_parts_name_what_went_wrong():
    """One point is 2 off, one truth has no estimate near, two estimates are false."""
    found = gospa([(0, 2), (100, 0), (200, 0)], [(0, 0), (50, 50)], 10, 2)
    assert found[1:] == (4.0, 50.0, 100.0)


def test_far_pairs_are_pairs_unless_alpha_is_two():
    far = [(0, 0)], [(20, 0)]
    assert gospa(*far, 10, 2, alpha=1)[1:] == (100.0, 0.0, 0.0)
    assert gospa(*far, 10, 2, alpha=2)[1:] == (0.0, 50.0, 50.0)
    assert gospa(EMPTY, far[1], 10, 2, alpha=1).missed == 100.0


@given(POINTS, POINTS, POINTS, st.sampled_from([1.0, 2.0]), st.sampled_from([1.0, 2.0]))
def test_both_are_metrics(first, second, third, order, alpha):
    """Zero for equal sets in any order, symmetric, and no detour is shorter."""
    for distance in (
        lambda a, b: ospa(a, b, 10, order),
        lambda a, b: gospa(a, b, 10, order, alpha).total,
    ):
        assert distance(first, first[::-1]) == 0
        assert distance(first, second) == pytest.approx(distance(second, first), abs=1e-12)
        assert distance(first, third) <= distance(first, second) + distance(second, third) + 1e-9


@settings(max_examples=30)
@given(POINTS, POINTS)
def test_parts_make_the_whole(estimates, truths):
    found = gospa(estimates, truths, 5, 2)
    assert found.total**2 == pytest.approx(sum(found[1:]), abs=1e-9)
    mirrored = gospa(truths, estimates, 5, 2)
    assert (mirrored.missed, mirrored.false) == (found.false, found.missed)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (([(np.nan, 0)], THREE, 10), "finite"),
        (([(1, 2, 3)], THREE, 10), "3 components"),
        ((THREE, THREE, 0), "cutoff must be positive"),
        ((THREE, THREE, 10, 0.5), "order"),
        ((THREE, THREE, 10, 2, 3), "alpha"),
    ],
)
def test_bad_input_is_named(arguments, said):
    with pytest.raises(BadInput, match=said):
        gospa(*arguments)


@settings(max_examples=20)
@given(st.floats(0.1, 100.0), st.integers(0, 3))
def test_what_is_as_far_as_the_cutoff_is_no_pair(cutoff, paired):
    """One missed and one false, as beyond it; just within it is a pair."""
    near = [[1000.0 * cutoff * row, 0.0] for row in range(1, paired + 1)]
    for away, pairs in ((cutoff, 0), (2.0 * cutoff, 0), (np.nextafter(cutoff, 0.0), 1)):
        estimates, truths = [[0.0, away], *near], [[0.0, 0.0], *near]
        found = gospa(estimates, truths, cutoff)
        assert found.missed == found.false == pytest.approx((1 - pairs) * cutoff**2 / 2.0)
        assert found.localisation == pytest.approx(pairs * cutoff**2)
        assert len(gospa_pairs(estimates, truths, cutoff)[0]) == paired + pairs
