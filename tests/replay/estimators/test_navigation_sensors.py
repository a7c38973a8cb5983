"""What a navigating body carries beside GNSS: each sensor's mathematics, and what wheels are worth."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.estimators.navigation import sensors
from fuselog.replay.estimators.navigation.alignment import specific_force
from fuselog.replay.estimators.navigation.navigation import INERTIAL, NavigationParameters
from tests.replay.inference.replays import outputs

TURNED = Rotation.from_euler("ZYX", [2.0, 0.3, -0.4])
PLACE, VELOCITY, RATE = (
    np.array([3.0, -2.0, 5.0]),
    np.array([4.0, 1.0, -0.5]),
    np.array([0.1, -0.2, 0.3]),
)
STATE = (*PLACE, *VELOCITY, *TURNED.as_quat(scalar_first=True), 0.01, 0.02, 0.03, 0.1, 0.2, 0.3)


def settings(**values: float) -> Any:
    """Parameters as a filter has them."""
    return NavigationParameters(**values)


def test_a_compass_a_barometer_and_standing_measure_parts_of_the_state():
    forward = TURNED.apply([1.0, 0.0, 0.0])
    assert_allclose(sensors.be_headed(STATE, (), None), np.arctan2(forward[1], forward[0]))
    assert sensors.be_high(STATE, (), None) == (5.0,)
    assert sensors.stand(STATE, (), None) == tuple(VELOCITY)
    still = make_stream(
        "/a/standing", schemas.VECTOR_MEASUREMENT, np.array([1, 2]), value=np.array([[1.0], [0.0]])
    )
    assert_allclose(sensors.read_standing(still), [[0.0] * 3, [np.nan] * 3])


def test_wheels_measure_at_their_axle_and_do_not_slip():
    axle = np.array([-1.5, 0.2, -0.4])
    samples = (0.0, 0.0, 9.8, *(RATE + np.array(STATE[10:13])))
    given = settings(axle_x_m=-1.5, axle_y_m=0.2, axle_z_m=-0.4, wheel_scale=0.1)
    wanted = TURNED.inv().apply(VELOCITY) + np.cross(RATE, axle)
    assert_allclose(sensors.roll_along(STATE, samples, given), wanted * [1.1, 1.0, 1.0])
    stream = make_stream(
        "/a/wheel", schemas.ODOMETRY, np.array([1]), forward_mps=np.array([7.0]), turn_radps=np.zeros(1)
    )
    assert sensors.stay_on_wheels(STATE, samples, given) == sensors.roll_along(STATE, samples, given)[1:]
    rolling = make_stream(
        "/a/rolling", schemas.VECTOR_MEASUREMENT, np.array([1, 2]), value=np.array([[1.0], [0.0]])
    )
    assert_allclose(sensors.read_rolling(rolling), [[0.0] * 2, [np.nan] * 2])
    read = sensors.read_wheels(stream)
    assert_allclose(read, [[7.0, 0.0, 0.0]])


def test_a_magnetometer_and_tags_are_turned_with_the_body():
    field, tag, anchor = (
        np.array([1.0, 21.0, -43.0]),
        np.array([0.3, -0.1, 0.2]),
        np.array([9.0, 8.0, 1.0]),
    )
    given = settings(field_east_ut=1.0, field_north_ut=21.0, field_up_ut=-43.0)
    assert_allclose(sensors.feel_north(STATE, (), given), TURNED.inv().apply(field))
    wanted = np.linalg.norm(PLACE + TURNED.apply(tag) - anchor)
    assert_allclose(sensors.see_anchor(STATE, (*anchor, *tag), given), wanted)


def test_scales_are_taken_back_after_the_bias():
    given = settings(force_scale_x=0.02, force_scale_y=0.03, force_scale_z=-0.01)
    true, scale, bias = (
        np.array([1.0, 2.0, 9.8]),
        np.array([1.02, 1.03, 0.99]),
        np.array([0.1, 0.2, 0.3]),
    )
    measured = (*(scale * true + bias), 0.0, 0.0, 0.0)
    assert_allclose(specific_force(measured, bias, given), true)


OUTAGE = {"outages_s": [[30.0, 59.9]]}
BOARD = {"wheel_rate_hz": 5.0, "compass_rate_hz": 1.0, "barometer_rate_hz": 1.0}


def drives(runs: int) -> list[MemorySource]:
    """Drives whose second half is a tunnel."""
    given = {"duration_s": 60.0, "gnss": OUTAGE, "carried": BOARD}
    return [memory_source(*record_run("navigation", given, 1, run)) for run in range(runs)]


@pytest.mark.paper
def test_wheels_hold_a_tunnel_and_all_sensors_are_as_good_as_they_say():
    """Over 30 s without fixes; NEES of ten drives is near 15, NIS near one for each component."""
    sources = drives(10)
    found = outputs(INERTIAL, "ekf", sources)
    alone = outputs(
        INERTIAL, "ekf", sources, topics={"wheel": "", "heading": "", "height": ""}, every_s=1.0
    )
    far, nees = {}, []
    for name, states in (("with", found["state"]), ("without", alone["state"])):
        ends = []
        for run, source in enumerate(sources):
            truth, own = source.read(["/body/truth"])["/body/truth"], states.of_run(run)
            row = np.searchsorted(truth.publish_time_ns, own.publish_time_ns)
            error = difference(own["mean"], truth["state"][row], INERTIAL.kinds)
            end_ns = truth.publish_time_ns[0] + 59_850_000_000  # before the first fix again
            last = np.searchsorted(own.publish_time_ns, end_ns) - 1
            ends.append(np.hypot(*error[last, :2]))
            if name == "with":
                spread = own["covariance"].reshape(-1, 15, 15)[40:]
                nees.append(np.einsum("ni,nij,nj->n", error[40:], np.linalg.inv(spread), error[40:]))
        far[name] = float(np.sqrt(np.mean(np.square(ends))))
    assert far["with"] < 1.0 < 3.0 < far["without"]
    assert np.concatenate(nees).mean() == pytest.approx(15.0, abs=2.0)
    innovation = found["innovation"].stream
    names = innovation.metadata["components"].split(",")
    covariance = innovation["covariance"].reshape(-1, len(names), len(names))
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    by_component = np.nanmean(innovation["innovation"] ** 2 / variances, axis=0)
    kinds = dict(zip(names, by_component, strict=True))
    for name in ("heading_rad", "forward_mps", "z_m"):
        assert kinds[name] == pytest.approx(1.0, abs=0.25), name
