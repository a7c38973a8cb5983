"""Inertial navigation: its mathematics, its start, and the targets of the reference sheet."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.models.inertial import earth_rate, from_mounting, gravity, into_body, strapdown
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.recording import Recording, import_run, record_run
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.geodetic import in_plane, origins_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.estimators.navigation.alignment import align
from fuselog.replay.estimators.navigation.navigation import INERTIAL, NavigationParameters
from fuselog.replay.estimators.navigation.turning import move, move_back
from tests.replay.inference.replays import outputs

# --- the mathematics -------------------------------------------------------------------------------


def test_gravity_is_that_of_the_ellipsoid_and_less_with_height():
    assert gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert gravity(90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    assert gravity(40.0966916, 1601.435) == pytest.approx(9.79684, abs=5e-6)  # the sheet's


def test_the_mounting_turns_by_yaw_of_pitch_of_roll():
    roll, pitch, yaw = 0.3, -0.5, 1.2
    wanted = Rotation.from_euler("ZYX", [yaw, pitch, roll]).apply([1.0, 2.0, 3.0])
    assert_allclose(from_mounting(roll, pitch, yaw, (1.0, 2.0, 3.0)), wanted, rtol=1e-14)


def test_a_body_that_rests_on_the_turning_earth_stays_for_an_hour():
    place = 52.0, 100.0
    orientation = Rotation.from_euler("ZYX", [0.7, 0.2, -0.1]).as_quat(scalar_first=True)
    start = state = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *orientation)
    force = into_body(orientation, (0.0, 0.0, gravity(*place)))
    rate = into_body(orientation, earth_rate(place[0]))
    for _ in range(3600):
        state = strapdown(state, force, rate, 1.0, place)
    assert_allclose(state, start, atol=1e-8)


def test_a_body_on_a_circle_stays_on_it():
    """10 m/s on a radius of 50 m at the pole, leaning inwards; 1 ms steps are exact to a millimetre."""
    speed, radius, place = 10.0, 50.0, (90.0, 0.0)
    turn = speed / radius
    coriolis = 2.0 * earth_rate(90.0)[2] * speed
    state: Any = (
        radius,
        0.0,
        0.0,
        0.0,
        speed,
        0.0,
        *Rotation.from_euler("Z", 90, True).as_quat()[[3, 0, 1, 2]],
    )
    force = 0.0, speed * turn + coriolis, gravity(*place)
    rate = 0.0, 0.0, turn + earth_rate(90.0)[2]
    seconds = 2 * np.pi / turn
    for _ in range(10000):
        state = strapdown(state, force, rate, seconds / 10000, place)
    assert_allclose(state[:6], (radius, 0.0, 0.0, 0.0, speed, 0.0), atol=1e-3)


# --- where it starts -------------------------------------------------------------------------------


def simulated(**values: Any) -> dict[str, Stream]:
    """What an alignment is given of a simulated drive, by the model's names for the topics."""
    recording, _ = record_run("navigation", {"duration_s": 12.0, **values}, seed=2)
    return {stream.topic.removeprefix("/body/"): stream for stream in recording.streams}


def changed(streams: dict[str, Stream], topic: str, **columns: Any) -> dict[str, Stream]:
    """The streams with other columns of a topic."""
    stream = streams[topic]
    return {**streams, topic: replace(stream, columns={**stream.columns, **columns})}


@pytest.mark.parametrize("carrier", ["vehicle", "pedestrian"])
def test_a_start_is_as_near_to_the_truth_as_it_says(carrier: str):
    """A person turns away from the course, so that the heading's is another matter."""
    streams = simulated(carrier=carrier)
    start = align(streams, NavigationParameters(start_sigma_m=1.0, force_bias_sigma_mps2=0.1))
    truth = streams["truth"]
    [row] = np.flatnonzero(truth.publish_time_ns == start.time_ns)
    error = difference(start.mean[None], truth["state"][row : row + 1], INERTIAL.kinds)[0]
    sigma = np.sqrt(np.diag(start.covariance))
    if carrier == "pedestrian":
        error[8] = 0.0
    assert np.abs(error / sigma).max() < 4.0
    assert np.abs(error[9:12]).max() < 0.001  # of a bias of .003 rad/s, from 4 s of rest
    assert start.how == "levelled, with the course as its heading"


@pytest.mark.paper
@pytest.mark.parametrize(
    ("carrier", "given"),
    [
        ("vehicle", {}),
        ("pedestrian", {"speed_mps": 1.3, "duration_s": 20.0}),
        ("quadrotor", {"speed_mps": 4.0, "gnss": {"rate_hz": 1.0, "velocity_rate_hz": 0.0}}),
    ],
)
def test_what_is_not_given_of_a_start_is_found_honestly(carrier: str, given: dict[str, Any]):
    """Of 30 starts the mean square of a component is no more than its variance, but by chance.

    A person's heading swings about the course; fixes err by half a metre, and are used once more.
    """
    runs, squares, nees = 30, [], []
    for run in range(runs):
        values = {
            "duration_s": 12.0,
            "unit": {"rate_hz": 50.0},
            "carrier": carrier,
            "prior": {"is_told": False},
            **given,
        }
        recording, _ = record_run("navigation", values, 1, run)
        streams = {stream.topic.removeprefix("/body/"): stream for stream in recording.streams}
        start = align(streams, NavigationParameters())
        truth = streams["truth"]
        row = np.searchsorted(truth.publish_time_ns, start.time_ns)
        error = difference(start.mean[None], truth["state"][row : row + 1], INERTIAL.kinds)[0]
        squares.append(error**2 / np.diag(start.covariance))
        nees.append(error @ np.linalg.solve(start.covariance, error))
    highest = chi2.ppf(0.999, runs) / runs
    assert np.mean(squares, axis=0).max() < highest
    # nor is it wider than it need be: a bias of the gyro is its mean over the rest
    if carrier != "quadrotor":  # whose heading is unknown, which no covariance has
        assert np.mean(nees) < 15.0
        assert np.sqrt(start.covariance[9, 9]) < 0.001
        assert np.mean(squares, axis=0)[9:12].mean() > 0.3


def test_a_bias_of_the_accelerometer_and_the_tilt_go_together():
    """Levelled by a biased force, the body leans just as far as explains it."""
    streams = simulated(unit={"force_bias_sigma_mps2": 0.6})
    start, truth = align(streams, NavigationParameters()), streams["truth"]
    [row] = np.flatnonzero(truth.publish_time_ns == start.time_ns)
    error = -difference(start.mean[None], truth["state"][row : row + 1], INERTIAL.kinds)[0]
    both, tilt = start.covariance[np.ix_([6, 7], [12, 13])], start.covariance[6:8, 6:8]
    force = start.covariance[12:14, 12:14]
    explained = both @ np.linalg.solve(force, error[12:14])
    left = np.sqrt(np.diag(tilt - both @ np.linalg.solve(force, both.T)))
    assert np.abs(error[6:8]).max() > 5.0 * left.max()
    assert np.abs(error[6:8] - explained).max() < 3.0 * left.max()


@pytest.mark.parametrize("yaw_deg", [90.0, 180.0, -90.0])
def test_a_unit_that_is_mounted_otherwise_is_told_by_where_it_speeds_up(yaw_deg: float):
    """And what turns it is said; of one that is mounted as stated nothing is."""
    streams = simulated(duration_s=30.0, prior={"is_told": False})
    assert "mounted" not in align(streams, NavigationParameters()).how
    how = align(streams, NavigationParameters(mounting_yaw_rad=np.radians(yaw_deg))).how
    said = re.search(r"if the unit is mounted rotated, give mounting_yaw_rad=(\S+)", how)
    assert said is not None
    assert float(said[1]) == pytest.approx(0.0, abs=0.05)


def test_without_velocities_the_heading_is_unknown():
    streams = simulated(gnss={"velocity_rate_hz": 0.0})
    start = align(streams, NavigationParameters())
    assert start.how == "levelled, with an unknown heading"
    up = np.array(into_body(start.mean[6:10], (0.0, 0.0, 1.0)))
    assert up @ start.covariance[6:9, 6:9] @ up == pytest.approx(np.pi**2)
    assert start.covariance[3, 3] == 100.0


def test_numbers_of_other_units_and_clocks_are_told():
    streams = simulated()
    force, rate = (streams["inertial"][name] for name in ("specific_force_mps2", "turn_rate_radps"))
    for columns, told in (
        (
            {"specific_force_mps2": force / 9.80665},
            "specific force is 0.98.* m/s2 in the first 1 s; expected gravity, .* looks like g",
        ),
        (
            {"specific_force_mps2": 3.0 * force},
            "specific force is 2.* m/s2 in the first 1 s; expected gravity, 9.8 m/s2$",
        ),
        ({"specific_force_mps2": -force}, "points down .* mounting_roll_rad=3.14159"),
        ({"turn_rate_radps": np.degrees(rate)}, "turn rate at rest is .* looks like deg/s"),
    ):
        with pytest.raises(BadInput, match=f"topic /body/inertial: .*{told}"):
            align(changed(streams, "inertial", **columns), NavigationParameters())
    upside_down = changed(
        streams, "inertial", specific_force_mps2=force * [1, -1, -1], turn_rate_radps=rate * [1, -1, -1]
    )
    right = align(streams, NavigationParameters())
    turned = align(upside_down, NavigationParameters(mounting_roll_rad=np.pi))
    assert_allclose(turned.mean, right.mean, atol=1e-9)
    with pytest.raises(BadInput, match=r"no message of /body/fix is within .* if their clocks differ"):
        align(streams, NavigationParameters(fix_delay_s=3600.0))
    # what is stated of the start is its covariance, about the body's axes where it leans
    stated = align(streams, NavigationParameters(**SETTINGS))
    up = Rotation.from_quat(stated.mean[6:10], scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    tilt, heading = (SETTINGS[f"{name}_sigma_rad"] ** 2 for name in ("tilt", "heading"))
    sigmas = [SETTINGS[name] for name in ("start_sigma_m", "start_sigma_mps", "gyro_bias_sigma_radps")]
    blocks = [sigma**2 * np.eye(3) for sigma in sigmas]
    blocks.insert(2, tilt * np.eye(3) + (heading - tilt) * np.outer(up, up))
    assert_allclose(stated.covariance[:12, :12], block_diag(*blocks), atol=1e-12)


# --- the walk, section 2 of the sheet; its outages are in the study `gnss-ins` ---------------------

# The sheet's; the mapping knows the mounting and the delay of the velocity.
SETTINGS: dict[str, float] = {
    "start_sigma_m": 0.05,
    "start_sigma_mps": 0.1,
    "force_noise_density": 0.05,
    "gyro_noise_density": 0.001,
    "force_bias_density": 3e-4,
    "gyro_bias_density": 2e-6,
    "tilt_sigma_rad": np.radians(3.0),
    "heading_sigma_rad": np.radians(20.0),
    "gyro_bias_sigma_radps": np.radians(0.2),
}


@pytest.fixture(scope="module")
def walk(navigation: Path) -> MemorySource:
    """By the mapping that ships, with the fixes from .2 s after the first inertial sample on."""
    folder = navigation / "gnss_imu_rtk" / "walk_0827"
    source = memory_source(*import_run("table", folder, {"mapping": "walk"}))
    begin_ns = source["/inertial"].publish_time_ns[0] + 2 * 10**8
    used = {
        topic: source[topic].take(source[topic].log_time_ns >= begin_ns)
        for topic in ("/fix", "/velocity")
    }
    return replace(source, streams={**source.streams, **used})


def test_the_walk_is_aligned_as_the_sheet_says(walk: MemorySource):
    fixes = gather([walk["/fix"]])
    streams = {name: walk[f"/{name}"] for name in ("inertial", "velocity")}
    streams["fix"] = in_plane(fixes, origins_of(fixes)).of_run(0)
    start = align(streams, NavigationParameters(**SETTINGS))
    yaw, pitch, roll = np.degrees(
        Rotation.from_quat(start.mean[6:10], scalar_first=True).as_euler("ZYX")
    )
    assert start.time_ns - walk.epoch_ns == 1.5e9
    assert max(abs(roll), abs(pitch)) < 1.5
    assert yaw == pytest.approx(-45.05, abs=3)  # the sheet's way, computed apart from this


@pytest.mark.paper
def test_the_likelihood_knows_the_lag_of_the_velocity_and_the_mounting(walk: MemorySource):
    def likelihood(since_s: float = 20.7, **settings: float) -> float:
        asked = {**SETTINGS, "gate_probability": 1.0, **settings}
        stream = outputs(INERTIAL, "ekf", [walk], **asked)["innovation"].stream
        late = stream.publish_time_ns > walk.epoch_ns + since_s * 1e9
        return float(stream["log_likelihood"][late].sum())

    best = likelihood()
    assert best - likelihood(velocity_delay_s=-0.125) == pytest.approx(1683, rel=0.03)
    assert likelihood(lever_y_m=-0.05) - best == pytest.approx(17, abs=5)
    assert best - likelihood(lever_y_m=0.05) == pytest.approx(74, abs=15)
    # a heading that is off by 180 deg, as it then is, is found while the body sets off
    assert likelihood(0.0) - likelihood(0.0, mounting_yaw_rad=np.pi) > 250
    assert best - likelihood(mounting_yaw_rad=np.pi) < 100


# --- simulated runs --------------------------------------------------------------------------------


@cache
def drives(runs: int, values: str) -> list[MemorySource]:
    """Drives of 28 s, at 50 samples/s if not given, once for all methods; the values given are JSON."""
    given = {"duration_s": 28.0, "unit": {"rate_hz": 50.0}, **json.loads(values)}
    return [memory_source(*record_run("navigation", given, 1, run)) for run in range(runs)]


def aligned_nees(method: str, runs: int = 40, **values: Any) -> tuple[Any, int]:
    """NEES (stamps, runs) of drives of 28 s, from 8 s on, when they move, and how many runs."""
    sources = drives(runs, json.dumps(values))
    states = outputs(INERTIAL, method, sources)["state"]
    nees = []
    for run, source in enumerate(sources):
        truth, own = source.read(["/body/truth"])["/body/truth"], states.of_run(run)
        row = np.searchsorted(truth.publish_time_ns, own.publish_time_ns)
        error = difference(own["mean"], truth["state"][row], INERTIAL.kinds)
        covariance = own["covariance"].reshape(-1, 15, 15)
        nees.append(np.sum(error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0], axis=1))
    return np.array(nees).T[40:], runs


@pytest.mark.paper
@pytest.mark.parametrize("method", ["ekf", "smoother"])
def test_the_error_of_all_15_states_is_what_the_covariance_says(method: str):
    """The mean NEES of 40 drives at 25 samples/s is in its 95 % interval nearly always."""
    nees, runs = aligned_nees(method, unit={"rate_hz": 25.0})
    low, high = chi2.ppf([0.025, 0.975], 15 * runs) / runs
    mean = nees.mean(axis=1)
    assert np.mean((mean > low) & (mean < high)) > 0.9
    assert mean.mean() == pytest.approx(15.0, abs=1.0)


@pytest.mark.paper
@pytest.mark.parametrize("method", ["ekf", "smoother"])
def test_from_a_heading_off_by_20_deg_errors_are_as_those_from_one_that_is_known(method: str):
    """Where each component is corrected by itself, the mean NEES of the filter is above 20."""
    turned = {"heading_sigma_rad": np.radians(20.0)}
    nees, _ = aligned_nees(method, unit={"rate_hz": 25.0}, prior=turned)
    assert nees.mean() == pytest.approx(15.0, abs=1.0)


@pytest.mark.parametrize("back", [False, True])
def test_a_heading_that_only_the_samples_tie_turns_all_that_they_say(back: bool):
    """The velocity's tangent is that of all its turn: a step of 40 deg turns it, and leaves the tilt."""
    before = np.array([5.0, 6.0, 7.0, 3.0, -4.0, 1.0, *np.zeros(10)])
    before[6:10] = Rotation.from_euler("ZYX", [1.0, 0.2, -0.3]).as_quat(scalar_first=True)
    up, slope, turn = into_body(before[6:10], (0.0, 0.0, 1.0)), np.zeros(15), np.radians(40.0)
    slope[3:5], slope[6:9] = (4.0, 3.0), up
    function = move_back if back else move
    after = np.array(function(tuple(before), tuple(turn * slope), tuple(slope)))
    assert_allclose(into_body(after[6:10], (0.0, 0.0, 1.0)), up, atol=1e-12)
    assert_allclose(after[3:6], Rotation.from_euler("Z", turn).apply(before[3:6]), atol=1e-12)
    assert_allclose(after[:3], before[:3])


def test_a_heading_that_nothing_ties_turns_alone():
    """What fixes add to the velocity is of the plane; what they add to a bias turns against the body."""
    before = np.array([5.0, 6.0, 7.0, 3.0, -4.0, 1.0, 1.0, *np.zeros(9)])
    slope, step, turn = np.zeros(15), np.zeros(15), np.radians(40.0)
    slope[8], step[8], step[3:5], step[12:14] = 1.0, turn, (-0.6, 0.8), (0.1, 0.0)
    after = np.array(move(tuple(before), tuple(step), tuple(slope)))
    assert_allclose(after[3:5], (2.4, -3.2))
    assert_allclose(after[13:15], 0.1 * np.array([np.cos(turn), -np.sin(turn)]))
    back = np.array(move_back(tuple(before), tuple(step), tuple(slope)))
    assert_allclose(back[3:5], before[3:5] + Rotation.from_euler("Z", turn).apply([-0.6, 0.8, 0.0])[:2])
    assert_allclose(back[13:15], (0.1, 0.0))


@pytest.mark.paper
@pytest.mark.parametrize(
    ("method", "given"),
    [
        ("ekf", {}),
        ("bank", {"carrier": "pedestrian", "speed_mps": 1.3}),
        (
            "bank",
            {
                "carrier": "quadrotor",
                "speed_mps": 4.0,
                "leg_s": 4.0,
                "gnss": {"velocity_rate_hz": 0.0},
            },
        ),
    ],
)
def test_a_start_without_a_prior_is_no_surer_than_it_may_be(method: str, given: dict[str, Any]):
    """Where the heading is next to unknown, by a bank: of 6 runs, which err alike for long."""
    nees, _ = aligned_nees(method, 6, prior={"is_told": False}, **given)
    assert 10.0 < nees.mean() < 20.0


def test_of_two_samples_of_one_stamp_both_count():
    """A body on the spot turns at 0.2 and 0 rad/s by turns: 1 rad in 10 s, though stamps repeat."""
    count = 2001
    stamps_ns = 10**9 + 10**7 * (np.arange(count) // 2)
    rate = np.where(np.arange(count)[:, None] % 2, [0.0, 0.0, 0.2], 0.0)
    unit = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        stamps_ns,
        specific_force_mps2=np.tile([0.0, 0.0, 9.80665], (count, 1)),
        turn_rate_radps=rate,
        magnetic_field_ut=np.full((count, 3), np.nan),
    )
    fix = make_stream(
        "/fix",
        schemas.POSITION_FIX,
        stamps_ns[::200],
        position_m=np.zeros((11, 3)),
        covariance_m2=np.ones((11, 3)),
    )
    run = RunMetadata("turns", epoch_ns=10**9)
    found = outputs(INERTIAL, "ekf", [memory_source(Recording([unit, fix]), run)])
    first, last = found["state"]["mean"][[0, -1], 6:10]
    w, _, _, z = compose(conjugate(first), last)
    assert 2.0 * np.arctan2(z, w) == pytest.approx(1.0, abs=0.02)


def test_halves_of_samples_make_no_start():
    """Of a unit whose accelerometer and gyro send their samples by turns, each without the other's."""
    stamps_ns, is_force = 10**9 + 10**7 * np.arange(400), np.arange(400)[:, None] % 2 == 0
    unit = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        stamps_ns,
        specific_force_mps2=np.where(is_force, [0.0, 0.0, 9.8], np.nan),
        turn_rate_radps=np.where(is_force, np.nan, [0.0, 0.0, 0.1]),
        magnetic_field_ut=np.full((400, 3), np.nan),
    )
    fix = make_stream(
        "/fix",
        schemas.POSITION_FIX,
        stamps_ns[::100],
        position_m=np.zeros((4, 3)),
        covariance_m2=np.ones((4, 3)),
    )
    source = memory_source(Recording([unit, fix]), RunMetadata("halves", epoch_ns=10**9))
    with pytest.raises(BadInput, match="/inertial: no sample has both specific force and turn rate"):
        outputs(INERTIAL, "ekf", [source])


def test_a_heading_may_state_its_covariance():
    """As headings of tables and of ROS do; the robot's model takes it too."""
    stamps_ns = 10**9 + 10**7 * np.arange(500)
    unit = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        stamps_ns,
        specific_force_mps2=np.tile([0.0, 0.0, 9.80665], (500, 1)),
        turn_rate_radps=np.zeros((500, 3)),
        magnetic_field_ut=np.full((500, 3), np.nan),
    )
    fix = make_stream(
        "/fix",
        schemas.POSITION_FIX,
        stamps_ns[::100],
        position_m=np.zeros((5, 3)),
        covariance_m2=np.ones((5, 3)),
    )
    found = []
    for states in ({"sigma_heading_rad": "0.02"}, {"covariance_rad2": "0.5,0,0,0,0.5,0,0,0,0.0004"}):
        heading = make_stream(
            "/heading",
            schemas.ORIENTATION,
            stamps_ns[50::100],
            metadata=states,
            quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
        )
        source = memory_source(Recording([unit, fix, heading]), RunMetadata("turns", epoch_ns=10**9))
        found.append(outputs(INERTIAL, "ekf", [source])["state"]["covariance"])
    assert_allclose(*found, rtol=1e-12)


@pytest.mark.parametrize("states", [True, False])
def test_gravity_is_that_of_the_fixes(states: bool):
    """A body that rests at 5 deg: at 45 deg gravity is 0.026 m/s2 more, and would be a bias."""
    place, stamps_ns = (5.0, 100.0, 30.0), 10**9 * np.arange(1, 61)
    samples_ns = np.arange(10**9, 61 * 10**9, 10**7)
    rest = np.tile([0.0, 0.0, gravity(place[0], place[2])], (len(samples_ns), 1))
    unit = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        samples_ns,
        specific_force_mps2=rest,
        turn_rate_radps=np.tile(earth_rate(place[0]), (len(samples_ns), 1)),
        magnetic_field_ut=np.full_like(rest, np.nan),
    )
    latitude, longitude, altitude = (np.full(60, each) for each in place)
    fix = make_stream(
        "/fix",
        schemas.GEODETIC_FIX,
        stamps_ns,
        metadata=Origin(*place).metadata if states else {},
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        covariance_m2=np.tile([0.01, 0.01, 0.01], (60, 1)),
    )
    run = RunMetadata("rest", epoch_ns=10**9)
    found = outputs(INERTIAL, "ekf", [memory_source(Recording([unit, fix]), run)])
    last = found["state"]["mean"][-1]
    assert_allclose(last[[2, 5, 15]], 0.0, atol=5e-3)
    told = sentences_of(found["started"].stream)
    assert not any("origin_latitude_deg" in each for each in told)
