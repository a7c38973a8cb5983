"""Calibration: car C of the sheet of sensors, section 2, and what its motion does not determine."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.stats import binom

import fuselog as fl
from fuselog.pipeline.altering.alterations import delayed
from fuselog.pipeline.calibrating import study
from fuselog.pipeline.calibrating.kalibr import FILE, kalibr_yaml
from fuselog.pipeline.calibrating.manoeuvres import (
    NAMES,
    OURS,
    TRUTH,
    WIDE,
    _simulated,
    advice,
    drive,
    gain,
    recorded,
)
from fuselog.pipeline.diagnosing.battery.car import drive as battery_drive
from fuselog.pipeline.diagnosing.battery.car import late
from fuselog.pipeline.diagnosing.battery.car import recorded as battery_recorded
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.command import progress_of
from fuselog.pipeline.tuning.control_noise import PAIRS, disturbed
from fuselog.pipeline.tuning.information import information
from fuselog.pipeline.tuning.objective import Best, Objective, Run
from fuselog.pipeline.tuning.search import Coordinates
from fuselog.pipeline.tuning.tuning import _levelled
from fuselog.recorders.common_streams import fix_stream, prior_stream, truth_stream
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.models.inertial import from_mounting
from fuselog.recorders.parameters import Parameter
from fuselog.recorders.recording import Recording
from fuselog.recorders.simulators.car import Floats, arcs, stamps_ns
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import memory_source
from tests.goldens import keeping

A_V, A_W, B_W = TRUTH[:3]
# the sheet's noise is that of the motion, ours that of the readings, which are its times the scales
OPEN = {
    "gate_probability": 1.0,
    "forward_noise_density": 0.05 * A_V,
    "turn_noise_density": 0.01 * A_W,
}
BY_SHEET = np.eye(7)  # derivatives of our parameters by the sheet's
BY_SHEET[0, 0], BY_SHEET[1, 1] = -1.0 / A_V**2, -1.0 / A_W**2
BY_SHEET[2, 1:3] = B_W / A_W**2, -1.0 / A_W
USEFUL = np.array([0.01, 0.01, 0.01, 0.2, 0.2, 0.05, 0.02])


@pytest.mark.paper
def test_the_car_of_the_sheet() -> None:
    car = drive(1)
    sums = [each.sum() for each in (car.speed_mps, car.turn_radps, car.fix_m, car.compass_rad)]
    assert sums == pytest.approx([10018.5904476, 14.594704982, 96427.5316865, 895.280996548], rel=1e-9)
    told = list[Best]()
    found = fl.calibrate(recorded(car), "ekf", set=OPEN, on_best=told.append)
    assert list(told[-1].names) == found.parameters["parameter"].tolist()
    rows = found.parameters.set_index("parameter").loc[list(NAMES)]
    forward, turn, bias, *others = rows["value"]
    values = np.array([1.0 / forward, 1.0 / turn, -bias / turn, *others])
    best = [1.029874887, 0.9787886879, 0.01148981965, 1.249610803, -0.3824990073, 0.1636707698]
    sigma = np.array([7.1829e-4, 0.0044225, 8.9938e-4, 0.102798, 0.037706, 0.011212, 9.2673e-4])
    assert np.all(np.abs(values - [*best, 0.04897362472]) < 0.1 * sigma)
    errors = (rows["high"] - rows["low"]).to_numpy() / 2.0 / 1.959964
    assert errors[3:] == pytest.approx(sigma[3:], rel=0.02)
    assert -found.costs[1] == pytest.approx(1304.018371, abs=0.5)
    assert not found.found.held
    assert yaml.safe_load(found.files[FILE])["fix"]["timeshift_sensor_body"] == pytest.approx(
        -0.1637, abs=2e-3
    )


@pytest.mark.parametrize(
    ("motion", "eigenvalues", "held"),
    [
        ("turns at changing speed", [3.276, 5.103, 28.15, 110.2, 123.3, 195.3, 466.0], []),
        ("straight", [123.3, 267.8, 566.3], ["turn_scale", "lever_x_m", "lever_y_m", "fix_delay_s"]),
        ("circle", [143.0, 150.0, 559.0], list(NAMES)),
        ("slalom", [0.142, 6.93, 11.5, 56.4, 123.0, 232.0, 534.0], ["lever_x_m", "fix_delay_s"]),
    ],
)
@pytest.mark.paper
def test_what_the_motion_does_not_determine_is_named_and_held(
    motion: str, eigenvalues: list[float], held: list[str]
) -> None:
    log = recorded(drive(None, motion=motion, **WIDE))
    found = fl.calibrate(log, "ekf", set=OPEN | dict(zip(NAMES, OURS.tolist(), strict=True)))
    assert {*found.found.held} == {*held}
    rows = found.parameters.set_index("parameter")
    assert rows.loc[held, "low"].isna().all()
    assert (rows.loc[held, "value"] == rows.loc[held, "start"]).all()
    assert rows.drop(held)["low"].notna().all()
    assert any("the motion in the logs does not determine" in each for each in found.notes) == bool(held)

    names = [each.name for each in found.found.coordinates.free]
    order = [names.index(name) for name in NAMES]
    values, useful = np.empty(7), np.empty(7)
    values[order], useful[order] = OURS, USEFUL
    turned = BY_SHEET * USEFUL / USEFUL[:, None]
    told = turned.T @ information(found.objective, values, useful, order) @ turned
    known = len(eigenvalues)
    computed = np.linalg.eigvalsh(told)
    assert computed[-known:] == pytest.approx(eigenvalues, rel=0.02)
    assert np.all(computed[: 7 - known] < 1e-3)


def test_kalibr_is_told_what_sensors_measure() -> None:
    """A point on the unit's forward axis, and a heading, are as the models have them."""
    angles, point = (0.3, -0.2, 1.1), np.array([1.0, 2.0, 3.0])
    names = ("mounting_roll_rad", "mounting_pitch_rad", "mounting_yaw_rad")
    values = dict(zip(names, angles, strict=True)) | {"lever_x_m": 1.2, "velocity_delay_s": 0.1}
    told = yaml.safe_load(kalibr_yaml(values | {"turn_scale": 1.02}, ["lever_x_m"]))
    in_body = np.array(from_mounting(*angles, tuple(point)))
    in_sensor = np.array(told["inertial"]["T_sensor_body"]) @ [*in_body, 1.0]
    assert in_sensor == pytest.approx([*point, 1.0], abs=1e-5)
    assert np.array(told["fix"]["T_sensor_body"]) @ [1.2, 0.0, 0.0, 1.0] == pytest.approx([0, 0, 0, 1])
    east = np.array(
        yaml.safe_load(kalibr_yaml({"bias_heading_rad": 0.5}, []))["heading"]["T_sensor_body"]
    ) @ [1.0, 0.0, 0.0, 1.0]
    assert east == pytest.approx([np.cos(0.5), -np.sin(0.5), 0.0, 1.0], abs=1e-5)
    assert told["velocity"] == {"timeshift_sensor_body": -0.1}
    assert told["errors"] == {"turn_scale": 1.02}


def test_bounds_above_zero_leave_a_parameter_its_intervals() -> None:
    """The search goes over the lever arm itself, not over its logarithm."""
    log, known = recorded(drive(1, duration_s=30.0)), [*NAMES[:3], *NAMES[4:]]
    given = {"fixed": known, "set": OPEN | dict(zip(NAMES, OURS.tolist(), strict=True))}
    found = fl.calibrate(log, "ekf", bounds={"lever_x_m": (0.1, 3.0)}, **given).parameters.iloc[0]
    alone = fl.calibrate(log, "ekf", **given).parameters.iloc[0]
    assert [*found[["value", "low", "high"]]] == pytest.approx(
        [*alone[["value", "low", "high"]]], rel=1e-3
    )


def test_what_cannot_be_calibrated_is_refused() -> None:
    log = recorded(drive(None, duration_s=3.0))
    refused = "--fixed lever_z_m: not a calibration parameter; choose from forward_"
    with pytest.raises(fl.BadInput, match=refused):
        fl.calibrate(log, "ekf", fixed=["lever_z_m"])
    with pytest.raises(fl.BadInput, match="calibrate: by is an option of tune only"):
        fl.calibrate(log, "ekf", by="rmse")
    bounds = {"lever_x_m": (0.1, 2.0)}
    with pytest.raises(
        fl.BadInput,
        match=r"--bound lever_x_m=0.1:2: expected bounds on both sides of the start "
        r"value, 0; give other bounds, or --set lever_x_m=...",
    ):
        fl.calibrate(log, "ekf", bounds=bounds)
    without = replace(
        log, streams={name: log.streams[name] for name in log.streams if "fix" not in name}
    )
    found = fl.calibrate(log, "ekf")
    with pytest.raises(fl.BadInput, match="--next: run 0 of car C has no odometry with fixes"):
        advice(replace(found, logs=[without]))
    for left_out in ("nothing", "/car/heading"):  # a manoeuvre has the sensors of the log
        streams = {name: log.streams[name] for name in log.streams if name != left_out}
        made = _simulated(found, replace(log, streams=streams), "circle").trial.source
        assert {*made.topics} == {*streams}


@pytest.mark.paper
def test_the_next_manoeuvre_is_the_sheets() -> None:
    """The prior is the sheet's, in useful units; each manoeuvre has a start of its own."""
    log = recorded(drive(None, motion="straight", duration_s=60.0, **WIDE))
    found = fl.calibrate(log, "ekf", set=OPEN, next_motion=True)
    names = [each.name for each in found.found.coordinates.free]
    order = [names.index(name) for name in NAMES]
    values, useful = np.empty(7), np.empty(7)
    values[order], useful[order] = OURS, USEFUL
    turned = BY_SHEET * USEFUL / USEFUL[:, None]

    def told(motion: str, duration_s: float) -> Floats:
        log = recorded(drive(None, motion=motion, duration_s=duration_s, **WIDE))
        run = Run(Trial("ekf", Ensemble([log]), OPEN))
        objective = replace(found.objective, runs=[run])
        objective.begin(values)
        return turned.T @ information(objective, values, useful, order) @ turned

    prior = np.diag(np.square(USEFUL / [0.1, 0.1, 0.02, 2.0, 2.0, 0.5, 0.2]))
    known = prior + told("straight", 60.0)
    both, varied = (
        gain(known, told(motion, 20.0))
        for motion in ("circles in both senses", "turns at changing speed")
    )
    assert (both.nats, both.widest) == pytest.approx((11.102931, 5.030), rel=0.02)
    assert (varied.nats, varied.widest) == pytest.approx((10.777415, 1.454), rel=0.02)
    assert varied.sigmas * USEFUL == pytest.approx(
        [0.000883, 0.012926, 0.00118, 0.29077, 0.11701, 0.02947, 0.00118], rel=0.02
    )
    said = [each for each in found.notes if "record turns at changing speed: of 6 manoeuvres" in each]
    assert said
    assert any("by the determinant" in each for each in found.notes)


def test_the_study_counts_what_intervals_hold_and_what_motions_leave_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of three cars, each a tenth further off than the one before; intervals are .15 to either side."""
    cars = iter(range(100))

    def calibrated(log: object, estimators: dict[str, object]) -> SimpleNamespace:
        values = OURS + 0.1 * next(cars)
        columns = {"parameter": NAMES, "value": values, "low": values - 0.15, "high": values + 0.15}
        held = [] if log.read(["/car/prior"])["/car/prior"]["covariance"][0, 0] == 100.0 else NAMES[3:5]
        found = SimpleNamespace(held=held)
        return SimpleNamespace(parameters=pd.DataFrame(columns), found=found)

    monkeypatch.setattr(study, "calibrate", calibrated)
    experiment = SimpleNamespace(runs=3, estimators={"ekf": {}})
    setting = SimpleNamespace(
        options=study.CalibrationOptions(seeds=(1,)), progress=lambda each, *_: each
    )
    outcome = study.study(experiment, setting)
    keeping.hold_outcome("calibration", {}, outcome)
    found = outcome.metrics
    assert {found[f"ekf.covered.0-{name}"] for name in NAMES} == {2.0}
    assert found["ekf.spread.0-lever_x_m"] == pytest.approx(0.1 / (0.3 / 3.919928))
    is_open = [found[f"ekf.left_open.changing-speed-{name}"] for name in NAMES]
    assert is_open == [0, 0, 0, 1, 1, 0, 0]


def driven(
    seed: int,
    speed: Floats,
    turn: Floats,
    step_s: float,
    densities: tuple[float, float],
    sigma_m: float,
    lever_m: float = 0.0,
    every: int = 2,
    first: int = 5,
) -> fl.MemorySource:
    """A robot drives for so many steps; fixes at every so many of them are of its antenna."""
    rng, count = np.random.default_rng(seed), len(speed)
    moved = arcs(np.cumsum(turn * step_s) - turn * step_s, speed, turn, np.full(count, step_s))
    pose = np.cumsum(moved, axis=0) - moved
    x, y, heading = pose[first::every].T
    antenna = np.stack([x + lever_m * np.cos(heading), y + lever_m * np.sin(heading)], axis=1)
    ticks_ns = stamps_ns(step_s * np.arange(count))
    noise = rng.standard_normal((count, 2)) * densities / step_s**0.5
    wheels = fl.make_stream(
        "/robot1/odometry",
        fl.schemas.ODOMETRY,
        ticks_ns,
        metadata=dict(
            zip(("forward_noise_density", "turn_noise_density"), map(repr, densities), strict=True)
        ),
        forward_mps=speed + noise[:, 0],
        turn_radps=turn + noise[:, 1],
    )
    fixes = antenna + sigma_m * rng.standard_normal(antenna.shape)
    start = np.diag([0.1, 0.1, 0.1])
    prior = prior_stream("/robot1/prior", 0, ("x_m", "y_m", "heading_rad"), np.zeros(3), start)
    streams = [wheels, fix_stream("/robot1/fix", ticks_ns[first::every], fixes, sigma_m**2), prior]
    return memory_source(Recording(streams), RunMetadata("driven", epoch_ns=0))


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_a_lever_arm_is_found_from_a_start_at_which_the_filter_diverges() -> None:
    """It turns on the spot for 20 s, then drives; without the lever arm NIS is above 100."""
    time_s = 0.05 * np.arange(1200)
    speed = np.where(time_s < 20.0, 0.0, 0.8)
    turn = np.where(time_s < 20.0, 0.4, 0.25 * np.sin(0.2 * time_s))
    log = driven(1, speed, turn, 0.05, (0.01, 0.005), 0.02, lever_m=0.3, every=20)
    lever = fl.tune(log, "ekf", "lever_x_m").parameters.iloc[0]
    assert lever["low"] < 0.3 < lever["high"]
    assert lever["high"] - lever["low"] < 0.05
    first = fl.diagnose(log, "ekf").sentences[0]
    assert (first.kind, first.where) == ("parameter", "lever_x_m")


@pytest.mark.paper
def test_intervals_of_delays_hold_the_truth_as_often_as_they_say() -> None:
    """Wheels that err by more than the fixes, of which each is at a stamp of theirs: 3 logs."""
    time_s = 0.1 * np.arange(300)
    speed, turn = 1.5 + 0.8 * np.sin(0.4 * time_s), 0.3 * np.sin(0.25 * time_s) + 0.05
    rows = []
    for seed in range(9000, 9003):
        log = driven(seed, speed, turn, 0.1, (0.05, 0.003), 0.01, every=1)
        rows.append(fl.tune(log, "ekf", "fix_delay_s").parameters.iloc[0])
    found = pd.DataFrame(rows)
    covered = int(((found["low"] < 0.0) & (found["high"] > 0.0)).sum())
    assert covered >= binom.ppf(0.005, len(found), 0.95)
    assert found["value"].abs().median() < 0.016  # 0.02 if an edge of the likelihood attracts it
    assert (found["high"] - found["low"]).median() < 0.08


@pytest.mark.parametrize("has_prior", [True, False])
def test_points_cost_together_what_each_costs_alone(*, has_prior: bool) -> None:
    """Also those with other delays, of which one puts fixes after the end, and those that fail."""
    log = recorded(drive(1, duration_s=10.0))
    given = {name: log.streams[name] for name in log.topics if has_prior or "prior" not in name}
    run = Run(Trial("ekf", Ensemble([replace(log, streams=given)]), OPEN))
    objective = Objective(["forward_scale", "fix_delay_s"], [run], "likelihood", 0.2)
    objective.begin(np.array([1.0, 0.0]))
    objective.correct(np.array([1.0, 0.0]))
    points = np.array([[1.0, 0.0], [1.1, 0.0], [1.0, 0.3], [0.9, -0.2], [1e200, 0.1], [-1.0, 0.1]])
    together = objective(points)
    assert together.tolist() == [objective(point[None]).item() for point in points]
    assert len({*together.tolist()}) == len(points)
    assert np.isinf(together).tolist() == [False, False, False, False, True, False]


def test_noise_that_is_added_cancels_among_nearby_messages() -> None:
    log = recorded(drive(1, duration_s=10.0))
    bound = bind("ekf", [log], {"kind": "ekf"})
    speed = np.array([
        each.streams["/car/odometry"]["forward_mps"] - log.streams["/car/odometry"]["forward_mps"]
        for each in disturbed(log, bound)
    ])  # fmt: skip
    products = speed.T @ speed / len(speed)
    near = np.abs(np.subtract.outer(np.arange(100), np.arange(100))) < PAIRS
    variance = 0.05**2 / 0.1
    assert np.allclose(np.where(near, products, 0.0), np.eye(100) * products[0, 0], atol=1e-12)
    assert 0.5 * variance < products[0, 0] <= 1.001 * variance
    assert np.allclose(speed.sum(axis=0), 0.0, atol=1e-12)


def test_a_level_point_is_not_attracted_by_an_edge() -> None:
    """A parabola whose least is at 0.1, with an edge at 0 that moves the least cost to 0.3."""

    class Edged:
        is_corrected = True

        def __call__(self, points: Floats) -> Floats:
            x = points[:, 0]
            return 50.0 * (x - 0.1) ** 2 - 20.0 * np.abs(x)

    free = [Parameter("delay_s", 0.0, low=-10.0, high=10.0, useful=1.0)]
    coordinates = Coordinates(free, np.ones(1))
    level = _levelled(Edged(), coordinates, np.array([0.3]), [0], np.ones(1))  # type: ignore[arg-type]
    assert level[0] == pytest.approx(0.1 / (1.0 - 20.0 / 100.0), abs=0.01)


@pytest.mark.paper
def test_a_delay_can_be_tuned_by_the_error() -> None:
    """A delay adds estimates, and puts the first fix before the prior: neither stops the search."""
    car = late(0.3)(battery_drive(5, duration_s=40.0))
    log, at_s = battery_recorded(car, has_prior=True), np.arange(0.0, 40.0, 0.05)
    pose = ("x_m", "y_m", "heading_rad")
    truth = truth_stream("/car/truth", stamps_ns(at_s), pose, car.truth.at(at_s))
    log = replace(log, streams={**log.streams, truth.topic: truth})
    found = fl.tune(log, "ekf", "fix_delay_s", by="rmse")
    assert found.parameters.loc[0, "value"] == pytest.approx(0.3, abs=0.05)


@pytest.mark.paper
def test_what_depends_on_a_value_that_is_held_is_said() -> None:
    """Fixes that are 0.3 s late, along a short straight line, are a scale of 0.95."""
    errors = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    prior = {"prior_sigma_m": 0.05, "prior_sigma_rad": 0.02}
    log = recorded(drive(None, errors, motion="straight", duration_s=8.0, **prior))
    found = fl.calibrate(log, "ekf")
    assert "fix_delay_s" in found.found.held
    scale = found.parameters.set_index("parameter").loc["forward_scale"]
    assert scale["high"] < 0.97
    [sentence] = [each for each in found.notes_of_search if each.startswith("forward_scale: ")]
    said = re.search(r"(\S+) if fix_delay_s is larger by 0.05", sentence)
    assert said is not None
    assert scale["value"] + 6.0 * float(said[1]) == pytest.approx(1.0, abs=0.005)


def test_a_search_without_a_usable_value_says_so() -> None:
    none = Best(3, np.empty(0), np.inf)
    assert progress_of(none) == "3 evaluations; no values found yet with which all logs can be replayed"
    found = Best(4, np.array([0.25]), 1.0, ["lever_x_m"])
    assert progress_of(found) == "4 evaluations; best so far: lever_x_m 0.25"


def late_fixes(delay_s: float, first: int) -> fl.MemorySource:
    """40 s of noisy wheels, with the first fix at the wheels' stamp of this number."""
    time_s = 0.1 * np.arange(400)
    speed, turn = 1.5 + 0.8 * np.sin(0.4 * time_s), 0.3 * np.sin(0.25 * time_s) + 0.05
    log = driven(1, speed, turn, 0.1, (0.05, 0.003), 0.01, first=first)
    late = delayed(log.streams["/robot1/fix"], delay_s)
    return replace(log, streams={**log.streams, "/robot1/fix": late})


@pytest.mark.paper
def test_a_delay_may_put_fixes_before_the_prior() -> None:
    """With a little more than the delay the first fix is before the prior, and gives no innovation.

    The wheels are noisy, so that fixes half a step later would average the noise of two readings.
    """
    found = fl.tune(late_fixes(0.06, first=0), "ekf", "fix_delay_s")
    row = found.parameters.iloc[0]
    assert row["low"] < 0.06 < row["high"]
    assert row["high"] - row["low"] < 0.08
    assert any(
        each.startswith("/robot1/fix: the search left out the first 3 messages") for each in found.notes
    )
    assert any(each.startswith("the noise of the control") for each in found.notes_of_search)


def test_ctrl_c_in_the_second_search_ends_with_the_best_of_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, stops = list[float](), iter([KeyboardInterrupt])
    correct = Objective.correct

    def noting(objective: Objective, values: Floats) -> None:
        first.extend(values)
        correct(objective, values)

    def stop(_: Best) -> None:
        for error in stops if first else ():
            raise error

    monkeypatch.setattr(Objective, "correct", noting)
    found = fl.tune(late_fixes(0.0, first=5), "ekf", "fix_delay_s", on_best=stop)
    assert found.notes[0].startswith("the search was stopped after ")
    assert found.parameters["value"].tolist() == first
