"""Paired differences: intervals that hold, verdicts that follow from them."""

import numpy as np
import pytest
from scipy import stats

import fuselog as fl
from fuselog.pipeline.comparing.candidates import Candidate, of_replay
from fuselog.replay.judging.errors.differences import paired_difference, target_of
from fuselog.replay.judging.intervals import RESAMPLES

PAIRS, RUNS = 200, 50
CALLED = ("better", "worse", "higher", "lower")


@pytest.fixture(scope="module")
def alike() -> Candidate:
    """An EKF over 100 runs: any 50 of them are as good as any others."""
    logs = [fl.record("landmarks", seed=11, run=run, duration_s=4.0) for run in range(2 * RUNS)]
    return of_replay("alike", fl.replay(logs, ["ekf"]), 0.2).candidate("ekf", "ekf")


@pytest.mark.paper
def test_of_pairs_without_a_difference_five_in_a_hundred_are_called(alike: Candidate) -> None:
    """A against A with margin 0, 200 times: 2 to 9 % for errors, and for what has an aim."""
    table = alike.rows.pivot(index="run", columns="quantity", values="value")
    table = table[["nees", "position_rmse_m"]]
    random = np.random.default_rng(3)
    splits = [random.permutation(2 * RUNS).reshape(2, RUNS) for _ in range(PAIRS)]
    shares = {}
    for quantity in table:
        values = table[quantity].to_numpy()
        target = alike.sizes.get((str(quantity), "robot1"), target_of(str(quantity)))
        verdicts = [paired_difference(*values[split], target, 0.0).verdict for split in splits]
        shares[quantity] = np.mean(np.isin(verdicts, CALLED))
    assert all(0.02 <= share <= 0.09 for share in shares.values()), shares


@pytest.mark.parametrize("runs", [5, 12, 3000])
def test_the_interval_is_the_bootstraps_of_scipy(runs: int) -> None:
    """Of percentiles that are widened for few runs, to the last bit, also in several batches."""
    first, second = np.random.default_rng(runs).lognormal(size=(2, runs))
    widened = np.sqrt(runs / (runs - 1)) * stats.t.ppf(0.975, runs - 1)
    theirs = stats.bootstrap(
        (first, second),
        lambda first, second, axis: second.mean(axis) - first.mean(axis),
        paired=True,
        n_resamples=RESAMPLES,
        confidence_level=2.0 * stats.norm.cdf(widened) - 1.0,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    ours = paired_difference(first, second, "low", 0.0)
    assert (ours.more.low, ours.more.high) == theirs.confidence_interval
    assert ours.sure == np.mean(np.sign(theirs.bootstrap_distribution) == np.sign(ours.more.value))


def test_a_verdict_says_where_the_interval_lies() -> None:
    random = np.random.default_rng(0)
    first = random.normal(10.0, 1.0, 40)
    second = first + random.normal(1.0, 0.1, 40)
    found = paired_difference(first, second, "low", 0.02)
    assert found.verdict == "worse"
    assert found.more.low < found.more.value < found.more.high
    assert found.more.value == pytest.approx(1.0, abs=0.06)
    # Student's interval of the same differences, which are normal
    apart = second - first
    half = 2.0227 * apart.std(ddof=1) / np.sqrt(40)
    assert [found.more.low, found.more.high] == pytest.approx(
        [apart.mean() - half, apart.mean() + half], abs=0.006
    )
    assert paired_difference(first, second, "high", 0.02).verdict == "better"
    assert paired_difference(second, first, "low", 0.02).verdict == "better"
    assert paired_difference(first, second, None, 0.02).verdict == "higher"
    assert paired_difference(first, second, "low", 0.2).verdict == "tie"
    for one, other in ((first, second), (second, first)):  # about the margin, above and below
        margin = found.more.value / one.mean()
        assert paired_difference(one, other, "low", margin).verdict == "undecided"
    assert paired_difference(first, first, "low", 0.0).verdict == "tie"


def test_what_has_an_aim_is_judged_by_its_distance() -> None:
    random = np.random.default_rng(1)
    about = random.normal(0.0, 0.1, 40)
    right, low, high = 3.0 + about, 2.5 + about[::-1], 3.5 + about[::-1]
    assert paired_difference(right, high, 3.0, 0.02).verdict == "worse"
    assert paired_difference(low, right, 3.0, 0.02).verdict == "better"
    # as far below as above: which is higher is sure, which is better is not
    assert paired_difference(6.0 - high, high, 3.0, 0.02).verdict == "higher"


def test_few_runs_have_no_interval() -> None:
    found = paired_difference(np.arange(4.0), np.arange(4.0) + 5.0, "low", 0.02)
    assert found.verdict == "undecided"
    assert np.isnan([found.more.low, found.more.high, found.sure]).all()
