"""The recorder `navigation`: what the unit and the receiver say belongs to the path."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.inertial import strapdown
from fuselog.recorders.recording import record_run

NOISELESS = {
    f"{sensor}_{kind}": 0.0 for sensor in ("force", "gyro") for kind in ("noise_density", "bias_density")
} | {"force_bias_sigma_mps2": 1e-12, "gyro_bias_sigma_radps": 1e-12}


def streams(seed: int = 1, **values: Any) -> dict[str, Stream]:
    """The streams of a run by the last part of their topics."""
    recording, _ = record_run("navigation", values, seed)
    return {stream.topic.rpartition("/")[2]: stream for stream in recording.streams}


@pytest.mark.parametrize(
    ("carrier", "speed_mps"), [("vehicle", 12.0), ("pedestrian", 1.3), ("quadrotor", 4.0)]
)
def test_a_unit_without_errors_leads_along_the_path(carrier: str, speed_mps: float):
    """Steps of the mean of two samples err by what the samples are apart, a little at 200 Hz."""
    unit = {"rate_hz": 200.0, **NOISELESS}
    log = streams(carrier=carrier, duration_s=20.0, speed_mps=speed_mps, unit=unit)
    truth, inertial = log["truth"]["state"], log["inertial"]
    force, rate = (
        (inertial[name][1:] + inertial[name][:-1]) / 2
        for name in ("specific_force_mps2", "turn_rate_radps")
    )
    state = tuple(truth[0, :10].tolist())
    for one_force, one_rate in zip(force.tolist(), rate.tolist(), strict=True):
        state = strapdown(state, one_force, one_rate, 0.005, (48.0, 500.0))
    end = np.array(state)
    end[6:] *= np.sign(end[6:] @ truth[-1, 6:10])
    assert np.abs(truth[-1, :3] - truth[0, :3]).max() > 2.0
    assert_allclose(end[:3], truth[-1, :3], atol=0.02)
    assert_allclose(end[3:6], truth[-1, 3:6], atol=0.01)
    assert_allclose(end[6:], truth[-1, 6:10], atol=1e-4)


def test_the_antenna_is_at_the_end_of_its_lever_and_moves_with_it():
    gnss = {
        "sigma_m": 1e-9,
        "sigma_up_m": 1e-9,
        "sigma_mps": 1e-9,
        "sigma_up_mps": 1e-9,
        "rate_hz": 50.0,
    }
    gnss |= {"velocity_rate_hz": 50.0}
    there = streams(carrier="pedestrian", duration_s=15.0, gnss=gnss | {"lever_m": [1.0, 0.5, 0.2]})
    here = streams(carrier="pedestrian", duration_s=15.0, gnss=gnss)
    arm = there["fix"]["position_m"] - here["fix"]["position_m"]
    assert_allclose(np.linalg.norm(arm, axis=1), np.linalg.norm([1.0, 0.5, 0.2]), atol=1e-6)
    moved = np.gradient(there["fix"]["position_m"], 0.02, axis=0)[1:-1]
    assert_allclose(moved, there["velocity"]["velocity_mps"][1:-1], atol=0.02)
    assert_allclose(arm[0] @ arm[0], 1.29, atol=1e-6)


def test_outages_float_solutions_bursts_and_delays_are_where_they_are_asked_for():
    spans: dict[str, Any] = {
        "outages_s": [[20.0, 25.0]],
        "floats_s": [[8.0, 12.0]],
        "multipath_s": [[14.0, 15.0]],
    }
    log = streams(duration_s=30.0, gnss=spans | {"delay_s": 0.25, "sigma_m": 0.01, "sigma_up_m": 0.01})
    fix, truth = log["fix"], log["truth"]
    since_s = (fix.publish_time_ns - truth.publish_time_ns[0]) * 1e-9 - 0.25
    assert not ((since_s > 19.99) & (since_s < 24.99)).any()
    assert since_s[0] == 0.0
    [end_ns] = log["outages"]["end_time_ns"]
    assert (end_ns - truth.publish_time_ns[0]) * 1e-9 == 25.0
    row = np.rint(since_s * 100).astype(int)
    error = fix["position_m"] - truth["state"][row, :3]
    is_float = (since_s >= 7.99) & (since_s < 11.99)
    assert_allclose(fix["covariance_m2"][:, 0], np.where(is_float, 0.01, 0.0001))
    assert np.abs(error[is_float]).std() > 5 * np.abs(error[since_s < 7.9]).std()
    burst = (since_s >= 13.99) & (since_s < 14.99)
    assert_allclose(error[burst].mean(axis=0), [3.0, -2.0, 5.0], atol=0.05)


def test_a_seed_gives_the_same_streams_and_way_points_are_passed():
    points = [[0.0, 0.0, 0.0], [50.0, 0.0, 1.0], [80.0, 40.0, 2.0], [80.0, 90.0, 0.0]]
    first, again = (streams(3, duration_s=35.0, way_points_m=points) for _ in range(2))
    for name, stream in first.items():
        for field in stream.schema:
            assert_array_equal(stream[field.name], again[name][field.name])
    place = first["truth"]["state"][:, :3]
    assert_array_equal(place[0], points[0])
    for point in points:
        assert np.linalg.norm(place - point, axis=1).min() < 0.1
    with pytest.raises(BadInput, match="way_points_m has 2 points; give three points or more"):
        streams(way_points_m=points[:2])
    with pytest.raises(
        BadInput, match="rest_s is 30 and duration_s 30: the body must move after its rest"
    ):
        streams(duration_s=30.0, rest_s=30.0)
