"""When an inertial unit's samples say that its body stands."""

import numpy as np
from numpy.testing import assert_allclose

from fuselog.recorders.models.standing import unrest

SECOND = 10**9
GRAVITY = np.array([0.3, -0.2, 9.8])


def test_the_window_is_that_before_a_sample():
    """Nothing is known before the first one is whole."""
    rng = np.random.default_rng(1)
    time_ns = np.arange(0, SECOND, SECOND // 50)
    force, rate = GRAVITY + rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    shaken, turned = unrest(time_ns, force, rate, 0.2)
    assert np.isinf(shaken[:10]).all()
    for row in (10, 30, 49):
        window = slice(row - 10, row + 1)
        deviation = np.sqrt(force[window].var(axis=0).sum())
        assert_allclose(
            (shaken[row], turned[row]), (deviation, np.sqrt((rate[window] ** 2).sum(1).mean()))
        )


def test_gaps_and_numbers_that_are_none_are_no_rest():
    time_ns = np.arange(0, 2 * SECOND, SECOND // 50)
    force, rate = np.tile(GRAVITY, (100, 1)), np.zeros((100, 3))
    force[60, 1] = np.nan
    time_ns[80:] += SECOND
    shaken, turned = unrest(time_ns, force, rate, 0.2)
    at_rest = np.isfinite(shaken) & np.isfinite(turned)
    wanted = np.ones(100, bool)
    wanted[:10] = wanted[60:71] = wanted[80:91] = False
    assert at_rest.tolist() == wanted.tolist()
    assert_allclose(shaken[wanted], 0.0, atol=1e-6)
