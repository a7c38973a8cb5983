"""Sequential tests hold what Wald and Page promise, on ratios whose distribution is known."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.biometrics.sequential import (
    Rates,
    decide,
    first_alarm,
    page_sums,
    thresholds,
    wald_bounds,
    wald_probes,
)

SHIFT = 0.5  # of a normal score of the person; the ratio of a score x is SHIFT x - SHIFT^2 / 2
RATES = Rates(0.01, 0.05)


def test_thresholds_are_walds():
    assert thresholds(Rates(0.01, 0.05)) == pytest.approx((np.log(0.05 / 0.99), np.log(95.0)))
    assert wald_bounds(Rates(0.01, 0.05)) == pytest.approx((0.01 / 0.95, 0.05 / 0.99))
    with pytest.raises(BadInput, match=r"error rates 0 and 0\.1: both must be above 0"):
        thresholds(Rates(0.0, 0.1))
    with pytest.raises(BadInput, match="their sum below 1"):
        thresholds(Rates(0.5, 0.5))


@pytest.mark.parametrize("genuine", [True, False])
def test_rates_and_mean_number_are_those_of_walds_theory(genuine):
    """Small ratios hardly overshoot: the approximations hold within a fifth, the bounds as they are."""
    rng, mean = np.random.default_rng(0), SHIFT if genuine else 0.0
    found = decide(
        lambda going: SHIFT * (mean + rng.normal(size=len(going))) - 0.5 * SHIFT**2, 20_000, RATES, 1000
    )
    assert (found.probes > 0).all()
    wrong = found.rejected if genuine else found.accepted
    bound = wald_bounds(RATES)[int(genuine)]
    assert 0.5 * bound < wrong.mean() < bound
    expected = wald_probes(RATES, (0.5 if genuine else -0.5) * SHIFT**2, genuine=genuine)
    assert found.probes.mean() == pytest.approx(expected, rel=0.2)
    assert found.probes.mean() > expected


def test_what_comes_to_no_decision_is_neither_accepted_nor_rejected():
    ratios = iter([np.array([9.0, -9.0, 0.5]), np.array([0.5])])
    found = decide(lambda _: next(ratios), 3, RATES, 2)
    np.testing.assert_array_equal(found.accepted, [True, False, False])
    np.testing.assert_array_equal(found.rejected, [False, True, False])
    np.testing.assert_array_equal(found.probes, [1, 1, 0])


def test_sums_begin_anew_below_zero():
    np.testing.assert_allclose(page_sums(np.array([-1.0, 2.0, -0.5, -3.0, 1.0])), [0, 2, 1.5, 0, 1])


@pytest.mark.paper
def test_false_alarms_are_no_more_frequent_than_stated_and_a_change_is_noticed():
    """For a shift of one sigma the delay is near the threshold over the divergence, 1/2 a probe."""
    score = np.random.default_rng(1).normal(size=(400, 20_000))
    alarm = first_alarm(page_sums(score - 0.5), 200.0)
    assert (alarm > 0).all()
    assert 200.0 < alarm.mean() < 2000.0
    delay = first_alarm(page_sums(score[:, :200] + 0.5), 200.0).mean()
    assert np.log(200.0) / 0.5 - 3.0 < delay < np.log(200.0) / 0.5 + 3.0
    np.testing.assert_array_equal(first_alarm(np.array([[0.0, 1.0], [5.2, 5.4]]), 100.0, 2), [0, 2])
