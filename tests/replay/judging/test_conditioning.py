"""What rounding leaves of covariances: least pivots, their samples, the alarm of a planted loss."""

from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.recorders.log import schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.judging.consistency.conditioning import Conditioning, conditioning_of, least_pivots

VECTOR = schemas.VECTOR_MEASUREMENT


def test_least_pivots_are_shares_of_variances_whatever_the_units() -> None:
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(5, 4, 4))
    covariances = roots @ roots.transpose(0, 2, 1)
    told = [
        min(
            1.0 / (np.linalg.inv(each[: n + 1, : n + 1])[n, n] * each[n, n])
            for n in range(4)  # what the components before leave of a variance
        )
        for each in covariances
    ]
    assert least_pivots(covariances) == pytest.approx(told)
    units = np.array([1.0, 1e-6, 1e9, 1e3])
    assert least_pivots(covariances * units * units[:, None]) == pytest.approx(told)
    known, unknown = covariances.copy(), covariances.copy()
    known[:, 2, :] = known[:, :, 2] = 0.0
    unknown[:, 2, :] = unknown[:, :, 2] = np.nan
    left = least_pivots(covariances[:, [0, 1, 3]][:, :, [0, 1, 3]])
    assert least_pivots(known) == pytest.approx(left)
    assert least_pivots(unknown) == pytest.approx(left)
    covariances[3] = [[1, 0, 0, 0], [0, 4, 6, 0], [0, 6, 4, 0], [0, 0, 0, 1]]
    told[3] = 1.0 - 1.5**2
    assert least_pivots(covariances) == pytest.approx(told)
    assert least_pivots(np.array([[[-1.0, 0.0], [0.0, 1.0]]])) == pytest.approx([-1.0])


def test_samples_say_where_the_worst_is() -> None:
    """Two runs of 3 estimates: what the second of the other run is like; and sums of blocks."""
    parts = []
    for run in range(2):
        covariance = np.tile(np.eye(2).ravel(), (3, 1))
        if run:
            covariance[1] = [1.0, 1.0, 1.0, 1.0]
        parts.append(
            fl.make_stream(
                "/estimates/ekf/state",
                schemas.GAUSSIAN_ESTIMATE,
                np.arange(1, 4) * 10**9 + run,
                metadata={"components": "x,y", "kinds": "linear,linear"},
                mean=np.zeros((3, 2)),
                covariance=covariance,
            )
        )
    found = conditioning_of(gather(parts), np.array([0, 10**9 + 1]), first_run=7)
    assert found == Conditioning(6, 1, 0, found.least, 8, 1.0)
    assert abs(found.least) < 1e-12
    other = Conditioning(10, 2, 1, -0.5, 3, 4.0)
    assert found.plus(other) == other.plus(found) == Conditioning(16, 3, 1, -0.5, 3, 4.0)


def sum_of_two(variance: float) -> fl.Model:
    """Two numbers that stay; their sum is measured."""

    def measured(state: Any, _reference: Any, _parameters: Any) -> Any:
        return (state[0] + state[1],)

    sensor = fl.Sensor("sum", VECTOR, {"sum": "linear"}, measured, lambda _: (variance,), vector="value")
    motion = fl.Motion(
        lambda state, _control, _duration_s, _parameters: (state[0], state[1]),
        lambda _state, _duration_s, _parameters: (0.0, 0.0),
    )
    names = {"x": "linear", "y": "linear"}
    return fl.Model("two numbers", names, fl.ModelParameters, (sensor,), motion)


@pytest.mark.parametrize(("variance", "is_lost"), [(1.0, False), (1e-9, True)])
def test_a_replay_says_what_rounding_has_left(variance: float, is_lost: bool, uncompiled: None) -> None:
    """A sum that is measured 1e17 times as well as its parts leaves no digit of what they are."""
    prior = fl.make_stream(
        "/car/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [10**9],
        metadata={"components": "x,y", "kinds": "linear,linear"},
        mean=[[0.0, 0.0]],
        covariance=[[1e8, 0.0, 0.0, 1e8]],
    )
    stamps_ns = np.arange(2, 6) * 10**9
    seen = fl.make_stream(
        "/car/sum", VECTOR, stamps_ns, metadata={"components": "sum"}, value=np.zeros((4, 1))
    )
    done = fl.replay(
        fl.Recording([prior, seen], epoch_ns=10**9), {"ekf": fl.modelled(sum_of_two(variance), "ekf")}
    )
    digits = [each.sentence for each in done.alarms if each.kind == "digits"]
    assert bool(digits) == is_lost
    assert all("covariance" in each and "samples" in each for each in digits)
