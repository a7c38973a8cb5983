"""What logs say of their faults without a filter: the sheet of sensors, sections 3 and 5."""

import re
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.diagnosing.battery import battery
from fuselog.pipeline.diagnosing.battery.car import (
    FAULTS,
    UNIT_FAULTS,
    Unit,
    faulty,
    recorded,
    recorded_unit,
    ride,
)
from fuselog.recorders.checks.body import Series, bodies
from fuselog.recorders.checks.lint import compared
from fuselog.recorders.checks.motion import BodyMotion, Forces, Lag
from fuselog.recorders.checks.speeds import scatter
from fuselog.recorders.checks.timing import Timing
from fuselog.recorders.checks.turns import _by_forces
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.orientation import compose
from fuselog.recorders.recording import record_run
from fuselog.recorders.simulators.car import arcs
from tests.pipeline.test_planes import HERE, car

FOUND = {  # of car D with its compass: cause, topic and setting that are named first
    "nothing": None,
    "fixes .3 s late": ("delay", "/car/fix", "/car/fix.delay_s"),
    "turn rate's sign": ("sign", "/car/odometry", "/car/odometry.turn_scale"),
    "speed x 3.6": ("unit", "/car/odometry", "/car/odometry.forward_scale"),
    "speed / 3.6": ("unit", "/car/odometry", "/car/odometry.forward_scale"),
    "speed x .3048": ("unit", "/car/odometry", "/car/odometry.forward_scale"),
    "lever (2, .6) m": None,
    "fix variance x 4": ("covariance", "/car/fix", "/car/fix.covariance_scale"),
    "fix variance / 16": ("covariance", "/car/fix", "/car/fix.covariance_scale"),
    "sd written as variance": None,  # of 43 numbers it is told in a fifth of the logs
    "E, N exchanged": ("sign", "/car/fix", ""),
    "degrees as radians": ("unit", "/car/odometry", "/car/odometry.turn_scale"),
    "gyro bias .02": None,
    "gyro bias .0004 t": None,
    "odometry clock 6 % fast": ("clock drift", "/car/odometry", "/car/odometry.clock_gain"),
    "fixes 18 s late": ("delay", "/car/fix", "/car/fix.delay_s"),
    "half of the odometry lost": ("lost messages", "/car/odometry", ""),
    "gyro density / 5": None,
    "compass + 4.5 deg": ("mounting", "/car/heading", ""),
    "compass clockwise from north": ("sign", "/car/heading", ""),
}
# The sheet's ratio, turn slope, variance at rest and lag.
CLEAN = (0.9956, 0.9852, 1.105, -0.04)
SPREADS = (0.0023, 0.0117, 0.25, 0.06)
SHEET = {
    "nothing": CLEAN,
    "fixes .3 s late": (0.9947, 0.9756, 1.051, 0.3),
    "turn rate's sign": (0.9956, -0.9852, 1.105, -0.04),
    "speed x 3.6": (0.2765, 0.9852, 1.105, -0.04),
    "fix variance x 4": (0.9956, 0.9852, 0.276, -0.04),
    "degrees as radians": (0.9956, 0.0172, 1.105, -0.04),
    "fixes 18 s late": (0.9956, 0.9852, 1.036, 17.96),  # the ratio and slope are of the shifted log
}


def motion_of(streams: Mapping[str, Stream]) -> BodyMotion:
    [body] = bodies(streams)
    return BodyMotion(body)


def test_a_winding_road_at_a_steady_speed_says_nothing() -> None:
    """Bends of one length: half a period late, the turn rate would be the other way round.

    And of six hundred lags some one is the best of speeds that hardly change.
    """
    for seed in (0, 7, 24):
        odometry, fix, _ = car(HERE.metadata, HERE.metadata, seed)
        assert not compared({each.topic: each for each in (odometry, fix)})


def winding(seed: int, period_s: float, late_s: float, speed_period_s: float) -> dict[str, Stream]:
    """Wheels, and late fixes of an antenna on a lever arm; infinite periods make a random drive."""
    rng, step_s, rows = np.random.default_rng(seed), 0.05, 1200
    time_s = step_s * np.arange(rows)
    phase, (turns, speeds) = rng.uniform(0.0, 2.0 * np.pi), rng.normal(size=(2, 32))
    turn = 0.3 * np.sin(2.0 * np.pi * time_s / period_s + phase)
    speed = 3.0 + 0.8 * np.sin(2.0 * np.pi * time_s / speed_period_s) * np.isfinite(speed_period_s)
    if np.isinf(period_s):
        turn = 0.3 * np.interp(time_s, 2.0 * np.arange(32), turns)
        speed = 4.0 + 0.8 * np.interp(time_s, 2.0 * np.arange(32), speeds)
    heading = np.cumsum(step_s * turn) - step_s * turn
    along = step_s * np.cumsum(speed * np.exp(1j * heading)) - step_s * speed * np.exp(1j * heading)
    seen = (along + (1.0 + 0.5j) * np.exp(1j * heading))[::4]
    place = np.stack([seen.real, seen.imag], axis=1) + 0.02 * rng.normal(size=(len(seen), 2))
    stamps_ns = np.rint(1e9 * (100.0 + time_s)).astype(np.int64)
    wheels = {
        "forward_mps": speed + 0.02 * (seed % 2) * rng.normal(size=rows),
        "turn_radps": turn + 0.005 * rng.normal(size=rows),
    }
    spread = np.tile(4e-4 * np.eye(2).ravel(), (len(seen), 1))
    fixes = {"position_m": place, "covariance_m2": spread}
    return {
        "/wheels": make_stream("/wheels", schemas.ODOMETRY, stamps_ns, **wheels),
        "/fix": make_stream("/fix", schemas.POSITION_FIX, stamps_ns[::4] + round(1e9 * late_s), **fixes),
    }


PERIODS_S = [
    (3.0, 3.0),
    (6.0, 7.0),
    (np.inf, np.inf),
    *(
        pytest.param(*each, marks=pytest.mark.paper)
        for each in ((3.0, np.inf), (15.7, np.inf), (15.7, 15.7))
    ),
]


@pytest.mark.paper
@pytest.mark.parametrize("late_s", [0.0, 0.25, 2.0])
@pytest.mark.parametrize(("period_s", "speed_period_s"), PERIODS_S)
def test_no_delay_is_named_that_is_a_period_off(
    period_s: float, speed_period_s: float, late_s: float
) -> None:
    """Nor one that is off by more than is stated; at random, most drives tell theirs."""
    named = 0
    for seed in range(4 if np.isinf(period_s) else 2):
        found = compared(winding(seed, period_s, late_s, speed_period_s))
        assert {each.kind for each in found} <= {"delay"}
        for each in found:
            [spread_s] = re.findall(r"give or take (\S+) s:", each.evidence)
            value_s = each.value if each.where == "/fix" else -each.value
            assert value_s == pytest.approx(late_s, abs=float(spread_s))
            assert float(spread_s) < 0.5
            named += 1
    assert named >= 3 * (np.isinf(period_s) and late_s > 0.0)


def test_a_speed_that_does_not_change_tells_no_delay() -> None:
    """Its sums differ by rounding, which may be like anything."""
    streams = winding(0, 15.7, 0.0, np.inf)
    assert np.ptp(streams["/wheels"]["forward_mps"]) == 0.0
    assert motion_of(streams).speed_lags == []


@pytest.mark.parametrize(
    ("seed", "off_m"), [(3, (3.0, -2.0)), (3, (6.0, -4.0)), (4, (6.0, -4.0)), (5, (3.0, -2.0))]
)
def test_a_receiver_that_jumps_is_named_and_not_the_wheels(
    seed: int, off_m: tuple[float, float]
) -> None:
    """For eight seconds fixes are metres off, on a robot that drives 0.6 m/s with right wheels."""
    fix, log = {"rate_hz": 5.0, "sigma_m": 0.3}, {"seed": seed, "duration_s": 60.0}
    streams = dict(fl.record("landmarks", **log, fix=fix, range_bearing={"rate_hz": 0.0}).streams)
    right = streams["/robot1/fix"]
    since_s = 1e-9 * (right.publish_time_ns - right.publish_time_ns[0])
    moved = right["position_m"] + np.outer((since_s > 25.0) & (since_s < 33.0), off_m)
    streams[right.topic] = replace(right, columns={**right.columns, "position_m": moved})
    assert {(each.kind, each.where) for each in compared(streams)} <= {("place", right.topic)}
    assert not compared({**streams, right.topic: right})
    if np.hypot(*off_m) > 5.0:
        [found] = compared(streams)
        assert found.value == pytest.approx(np.hypot(*off_m), abs=1.5)
        assert "at 25.2 s" in found.evidence or "at 33.0 s" in found.evidence


@pytest.mark.paper
@pytest.mark.parametrize("name", SHEET)
def test_ratios_slopes_scatter_and_lags_are_those_of_the_sheet(name: str) -> None:
    """Within 4 of the sheet's standard deviations."""
    motion = motion_of(recorded(faulty(2000, name)).streams)
    [speed], [turn], [fixes] = motion.body.speeds, motion.body.turns, motion.body.fixes
    ratio, slope = motion.speed(speed), motion.turn(turn)
    rest = scatter(fixes, motion.aligned(speed))
    assert ratio
    assert slope
    assert rest
    found = ratio.value, slope.value, rest[0], motion.speed_lags[0].timing.lag_s
    expected = np.array(SHEET[name])
    scale = np.array([*np.abs(expected[:3]), 1.0]) * SPREADS / np.array([*np.abs(CLEAN[:3]), 1.0])
    assert np.all(np.abs(np.array(found) - expected) < 4.0 * scale)


@pytest.mark.paper
@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_of_car_d_is_named_first_or_none(name: str) -> None:
    told = compared(recorded(faulty(2003, name)).streams)
    found = [(each.kind, each.where, each.setting.partition("=")[0]) for each in told]
    wanted = FOUND[name]
    if name != "sd written as variance":
        assert found == ([] if wanted is None else [wanted])


@pytest.mark.parametrize("name", UNIT_FAULTS)
def test_each_fault_of_the_inertial_unit_is_all_that_is_named(name: str) -> None:
    found = battery.unit_tried(name, 8000)
    wanted = battery.UNIT_RIGHT[name]
    assert found["is_first"], found["first"]
    assert found["findings"] == (1 if wanted else 0)
    if wanted:
        assert found["value"] == pytest.approx(abs(wanted[2]), rel=0.03, abs=0.03)


@pytest.mark.parametrize("scenario", ["landmarks", "navigation", "orientation", "vehicles"])
def test_scenarios_have_no_findings(scenario: str) -> None:
    recording, _ = record_run(scenario, {}, seed=5)
    assert compared({each.topic: each for each in recording.streams}) == []


def inertial(stamps_s: np.ndarray, force: np.ndarray) -> dict[str, Stream]:
    stream = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        np.rint(1e9 * stamps_s).astype(np.int64),
        specific_force_mps2=force,
        turn_rate_radps=0.0 * force,
        magnetic_field_ut=np.empty((len(force), 0)),
    )
    return {"/inertial": stream}


def test_loss_is_told_from_jitter() -> None:
    """Of logs of 100 Hz with jitter none loses; of those with half of it, each one does."""
    for seed, lost in ((901, 0.512641), (902, 0.503355), (903, 0.498495)):
        rng = np.random.Generator(np.random.Philox(key=seed))
        stamps = 1.0 + 0.01 * np.arange(6000) + 1e-4 * rng.standard_normal(6000)
        force = [0.0, 0.0, 9.81] + 0.05 * rng.standard_normal((6000, 3))
        kept = rng.random(6000) < 0.5
        assert compared(inertial(stamps, force)) == []
        [found] = compared(inertial(stamps[kept], force[kept]))
        assert (found.kind, found.value) == ("lost messages", pytest.approx(lost, abs=1e-6))


def test_quaternions_in_another_order_are_told_by_turn_rates() -> None:
    rng = np.random.default_rng(1)
    step_s, n = 0.01, 4000
    rate = np.sin(np.arange(n)[:, None] * [0.003, 0.005, 0.004]) + 0.01 * rng.standard_normal((n, 3))
    quaternion = np.empty((n, 4))
    quaternion[0] = 1.0, 0.0, 0.0, 0.0
    for row in range(1, n):
        half = 0.5 * step_s * rate[row - 1]
        step = np.concatenate([[np.sqrt(1.0 - half @ half)], half])
        quaternion[row] = compose(quaternion[row - 1], step)
    streams = inertial(step_s * np.arange(n), np.tile([0.0, 0.0, 9.81], (n, 1)))
    streams["/inertial"] = replace(
        streams["/inertial"], columns={**streams["/inertial"].columns, "turn_rate_radps": rate}
    )
    stamps_ns = np.rint(1e9 * step_s * np.arange(n)).astype(np.int64)
    opposite = np.array([1.0, -1.0, -1.0, -1.0])
    for order, factor, told in (
        ([0, 1, 2, 3], 1.0, []),
        ([1, 2, 3, 0], 1.0, ["are x, y, z, w,"]),
        ([0, 1, 2, 3], opposite, ["are w, x, y, z of the opposite rotation,"]),
        ([1, 2, 3, 0], opposite[[1, 2, 3, 0]], ["are x, y, z, w of the opposite rotation,"]),
        ([0, 1, 2, 3], 1.01, ["are not of unit length"]),
    ):
        streams["/orientation"] = make_stream(
            "/orientation", schemas.ORIENTATION, stamps_ns, quaternion=factor * quaternion[:, order]
        )
        found = compared(streams)
        assert len(found) == len(told)
        assert all(words in each.evidence for words, each in zip(told, found, strict=True))


def test_repeated_messages_and_a_gaining_clock_are_found() -> None:
    [wheels, *others] = recorded(faulty(2000, "nothing")).streams.values()
    twice = wheels.take(np.sort(np.concatenate([np.arange(len(wheels)), [7, 7]])))
    slow = replace(wheels, log_time_ns=(1.01 * wheels.publish_time_ns).astype(np.int64))
    rest = {each.topic: each for each in others}
    [found] = compared({wheels.topic: twice, **rest})
    assert found.evidence.startswith("/car/odometry: 2 of its 1002 messages are duplicates")
    [found] = compared({wheels.topic: slow, **rest})
    assert (found.kind, found.where) == ("clock drift", "/car/odometry")


def test_a_topic_is_moved_onto_the_clock_that_fits_it() -> None:
    """By lags and gains that are sure: of speeds beside places, of turns only where they are alike."""
    [body] = bodies(recorded(faulty(2000, "nothing")).streams)
    series = Series("/turns", "turn_radps", np.array([10.0, 11.0, 13.0]), np.array([1.0, 2.0, 4.0]))

    def times_s(way: str, speeds: Timing | None, turns: Timing | None) -> list[float]:
        motion = BodyMotion(body)
        for name, found in (("speed_lags", speeds), ("turn_lags", turns)):
            lags = [Lag(series.topic, "/car/fix", found)] if found else []
            setattr(motion, name, [Lag("/other", "/car/fix", SAME), *lags])
        moved = getattr(motion, way)(series)
        assert moved.values.tolist() == series.values.tolist()
        return moved.times_s.tolist()

    late, gaining = (
        Timing(-0.5, 0.0, 0.99, 9.0, True, 0.1, 0.1, True),
        Timing(-0.5, 0.1, 0.99, 9.0, True, 0.1, 0.1, True),
    )
    unlike, unsure = late._replace(likeness=0.5), late._replace(evidence=1.0)
    still, moved = [10.0, 11.0, 13.0], [9.5, 10.5, 12.5]
    slowed = [9.5, 10.4, 12.2]
    for speeds, turns, aligned, timed, likened in (
        (None, None, still, still, still),
        (late, None, moved, moved, moved),
        (gaining, None, slowed, slowed, slowed),
        (unsure, None, still, still, still),
        (None, gaining, slowed, still, slowed),
        (SAME, gaining, still, still, slowed),
        (SAME, late, still, still, moved),
        (SAME, unlike, still, still, still),
        (SAME, unsure, still, still, still),
        (gaining, late, slowed, slowed, slowed),
    ):
        found = [times_s(way, speeds, turns) for way in ("aligned", "timed", "likened")]
        assert found == [pytest.approx(each) for each in (aligned, timed, likened)], (speeds, turns)


@pytest.mark.parametrize(
    ("fit", "mirrored", "says"), [(0.99, 0.1, -1), (0.1, 0.99, 1), (0.3, 0.1, 0), (None, None, 0)]
)
def test_forces_are_witnesses_where_they_go_with_a_frame_or_its_mirror_image(
    fit: float | None, mirrored: float | None, says: int
) -> None:
    found = None if fit is None else Forces(0.0, fit, mirrored)
    own, other = (SimpleNamespace(topic=topic) for topic in ("/imu", "/other"))
    motion: Any = SimpleNamespace(
        body=SimpleNamespace(forces=[other, own]),
        aligned=lambda force: force,
        forces=lambda force: found if force is own else Forces(0.0, 1.0, 0.0),
    )
    assert _by_forces(motion, own) == says


SAME = Timing(0.0, 0.0, 0.99, 0.0, False, 0.1, 0.1, True)


def test_of_equal_stamps_the_first_is_taken() -> None:
    """Nothing is divided by no time: a log with each message twice says what it says with one."""
    for streams in (recorded(faulty(2000, "nothing")).streams, recorded_unit(ride(8000)).streams):
        twice = {
            topic: stream.take(np.repeat(np.arange(len(stream)), 2)) for topic, stream in streams.items()
        }
        [body], [doubled] = bodies(streams), bodies(twice)
        for role, again in zip(body.roles, doubled.roles, strict=True):
            for one, two in zip(role, again, strict=True):
                assert np.array_equal(one.times_s, two.times_s)
                assert np.array_equal(one.values, two.values)


def test_a_twist_in_the_plane_beside_an_inertial_unit_has_no_turn_rate_about_z() -> None:
    streams = recorded_unit(ride(8000)).streams
    [body] = bodies(streams)
    stamps_ns = next(iter(streams.values())).publish_time_ns
    empty = np.empty((len(stamps_ns), 0))
    still = np.zeros((len(stamps_ns), 2))
    twist = make_stream(
        "/unit/twist",
        schemas.TWIST,
        stamps_ns,
        velocity_mps=still,
        turn_rate_radps=still[:, :1],
        covariance=empty,
    )
    [also] = bodies({**streams, twist.topic: twist})
    assert [each.topic for each in also.turns] == [each.topic for each in body.turns]


def test_errors_that_are_not_white_say_nothing_of_their_variance() -> None:
    clean = recorded(faulty(2000, "fix variance x 4"))
    slow = clean.streams["/car/fix"]
    rows = np.arange(len(slow)) < 22
    place = slow["position_m"].copy()
    place[rows] = np.cumsum(place[rows] * 0.15, axis=0)
    drifting = replace(slow, columns={**slow.columns, "position_m": place})
    assert compared({**clean.streams, "/car/fix": drifting}) == []


def test_the_bias_of_forces_is_what_they_say_at_rest() -> None:
    """A car that only turns left is always pushed to the left: that is no bias, and fits its course."""
    sample_s, velocity_s = np.arange(0.0, 60.0, 0.02), np.arange(0.0, 60.0, 0.2)
    rest_s, speed_mps, turn_radps = 30.0, 6.0, 0.4
    turns = np.where(sample_s > rest_s, turn_radps, 0.0)
    pushed = np.array([0.3, -0.2, 9.81]) + np.outer(turns, [0.0, speed_mps, 0.0])
    angle = turn_radps * np.maximum(velocity_s - rest_s, 0.0)
    speeds = np.where(velocity_s > rest_s, speed_mps, 0.0)
    velocity = speeds[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    motion = motion_of(recorded_unit(Unit(sample_s, pushed, turns, velocity_s, velocity)).streams)
    found = motion.forces(motion.body.forces[0])
    assert found is not None
    assert found.fit > 0.99
    assert abs(found.angle_rad) < 0.1


def test_a_unit_upside_down_is_one_finding() -> None:
    """Its turn rate goes the other way round; right orientations and the wheels are not accused."""
    rng, step_s, count = np.random.default_rng(4), 0.05, 2400
    time_s = step_s * np.arange(count)
    turn = 0.35 * np.sin(0.3 * time_s) + 0.15
    heading = np.cumsum(turn * step_s) - turn * step_s
    moved = arcs(heading, np.full(count, 0.8), turn, np.full(count, step_s))
    stamps_ns, zero = np.rint(1e9 * time_s).astype(np.int64), np.zeros(count)
    at = slice(0, None, 20)
    half = 0.5 * heading[at] + 0.01 * rng.standard_normal(count // 20)
    place = np.cumsum(moved, axis=0) - moved
    force = np.stack([zero, 0.8 * turn, 9.81 + zero], axis=1) + 0.05 * rng.standard_normal((count, 3))
    rate = np.stack([zero, zero, turn + 0.01 * rng.standard_normal(count)], axis=1)
    streams = [
        make_stream(
            "/pose",
            schemas.POSE,
            stamps_ns[at],
            position_m=np.column_stack(
                [place[at, :2] + 0.05 * rng.standard_normal((count // 20, 2)), zero[at]]
            ),
            quaternion=np.stack([np.cos(half), zero[at], zero[at], np.sin(half)], axis=1),
            covariance=np.tile(np.diag([0.0025, 0.0025, 1, 1, 1, 0.0004]).ravel(), (count // 20, 1)),
        ),
        make_stream(
            "/imu",
            schemas.INERTIAL_SAMPLE,
            stamps_ns,
            specific_force_mps2=force * [1, -1, -1],
            turn_rate_radps=rate * [1, -1, -1],
            magnetic_field_ut=np.empty((count, 0)),
        ),
        make_stream("/odometry", schemas.ODOMETRY, stamps_ns, forward_mps=0.8 + zero, turn_radps=turn),
    ]
    [found] = compared({each.topic: each for each in streams})
    assert (found.kind, found.where, found.setting) == ("gravity", "/imu", "/imu.turn_rate_z_scale=-1")
    streams[1] = replace(streams[1], columns={**streams[1].columns, "turn_rate_radps": rate})
    [alone] = compared({each.topic: each for each in streams})
    assert (alone.kind, alone.setting) == ("gravity", "/imu.specific_force_z_scale=-1")


def test_fixes_that_go_astray_slowly_and_jump_back_tell_no_delay() -> None:
    sensors = {"fix": {"rate_hz": 5.0, "sigma_m": 0.3}, "range_bearing": {"rate_hz": 0.0}}
    recording, _ = record_run("landmarks", {"duration_s": 60.0, **sensors}, 3, 0)
    streams = {each.topic: each for each in recording.streams}
    fix = streams["/robot1/fix"]
    since_s = 1e-9 * (fix.publish_time_ns - fix.publish_time_ns[0])
    place = fix["position_m"].copy()
    place[:, :2] += np.outer(
        np.where(since_s < 33.0, np.clip((since_s - 25.0) / 8.0, 0.0, 1.0), 0.0), [12, 5]
    )
    streams["/robot1/fix"] = replace(fix, columns={**fix.columns, "position_m": place})
    assert [each.kind for each in compared(streams)] == ["place"]
