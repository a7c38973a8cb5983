"""EKF, UKF and dead reckoning beside a plain textbook version, and their honesty over 100 runs."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, t

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream, schemas
from fuselog.recorders.recording import Recording, record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.sampling.samplers import unscented
from fuselog.replay.judging.errors.evaluation import (
    Errors,
    chi_square_interval,
    errors_of,
    innovations_of,
)
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.metrics.metrics import INNOVATION

Floats = NDArray[np.float64]


def record(run: int = 0, **parameters: object) -> MemorySource:
    return memory_source(*record_run("landmarks", parameters, 2026, run))


def replayed(
    name: str, sources: list[MemorySource], order: Clock = "publish_time", **settings: object
) -> dict[str, Ragged]:
    """The outputs by the last part of their topic: pose, innovation, failure."""
    outputs = collect(replay(sources, bind(name, sources, settings), order=order))
    return {topic.rpartition("/")[2]: ragged for topic, ragged in outputs.items()}


# The textbook (Thrun, Burgard, Fox, Probabilistic Robotics, chapters 3 and 7): small matrices, one step
# at a time. A filter is a way to predict and a way to compare a measurement with its prediction.


def wrap(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def drive(x: Floats, velocity: Floats, duration: float) -> Floats:
    forward, turn = velocity
    end = x[2] + turn * duration
    if turn == 0:
        return x + np.array([forward * np.cos(end), forward * np.sin(end), 0]) * duration
    chord = np.array([np.sin(end) - np.sin(x[2]), np.cos(x[2]) - np.cos(end)]) * forward / turn
    return np.array([*(x[:2] + chord), end])


def drive_noise(x: Floats, velocity: Floats, duration: float, density: Floats) -> Floats:
    """Q = G diag(density^2 / T) G': white noise on the velocity has this mean over T."""
    steps = 1e-4 * np.eye(2)
    change = [drive(x, velocity + s, duration) - drive(x, velocity - s, duration) for s in steps]
    gain = np.transpose(change) / 2e-4
    return gain @ np.diag(density**2 / duration) @ gain.T


def look(x: Floats, place: Floats) -> Floats:
    east, north = place - x[:2]
    return np.array([np.hypot(east, north), wrap(np.arctan2(north, east) - x[2])])


class Ekf(NamedTuple):
    """The extended Kalman filter."""

    def predict(self, x: Floats, p: Floats, velocity: Floats, duration: float) -> tuple[Floats, Floats]:
        """Mean and covariance after the drive, before its noise."""
        moved = drive(x, velocity, duration)
        east, north, _ = moved - x
        f = np.array([[1, 0, -north], [0, 1, east], [0, 0, 1]])
        return moved, f @ p @ f.T

    def compare(self, x: Floats, p: Floats, place: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Innovation, its covariance before noise, and the state's covariance with it."""
        east, north = place - x[:2]
        r = np.hypot(east, north)
        h = np.array([[-east / r, -north / r, 0], [north / r**2, -east / r**2, -1]])
        v = z - look(x, place)
        return np.array([v[0], wrap(v[1])]), h @ p @ h.T, p @ h.T


class Ukf(NamedTuple):
    """The unscented Kalman filter; sigma points are drawn anew before every step."""

    kappa: float

    def sigma_points(self, x: Floats, p: Floats) -> tuple[Floats, Floats]:
        """Points (7, 3), the mean first, and weights (7,)."""
        root = np.linalg.cholesky((3 + self.kappa) * p)
        points = [x] + [x + column for column in root.T] + [x - column for column in root.T]
        return np.array(points), np.array([2 * self.kappa] + 6 * [1.0]) / (2 * (3 + self.kappa))

    def predict(self, x: Floats, p: Floats, velocity: Floats, duration: float) -> tuple[Floats, Floats]:
        """See `Ekf.predict`."""
        points, weights = self.sigma_points(x, p)
        moved = np.array([drive(point, velocity, duration) for point in points])
        mean = weights @ moved
        return mean, (weights * (moved - mean).T) @ (moved - mean)

    def compare(self, x: Floats, p: Floats, place: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """See `Ekf.compare`; angles as differences from the one at the mean."""
        points, weights = self.sigma_points(x, p)
        seen = np.array([look(point, place) for point in points])
        seen[:, 1] = [seen[0, 1] + wrap(bearing - seen[0, 1]) for bearing in seen[:, 1]]
        mean = weights @ seen
        v = z - mean
        spread = weights * (seen - mean).T
        return np.array([v[0], wrap(v[1])]), spread @ (seen - mean), (spread @ (points - x)).T


class Textbook(NamedTuple):
    """What the textbook makes of one run: at every stamp, and for every sighting of the map."""

    stamps: list[int]
    means: list[Floats]
    covariances: list[Floats]
    squared: list[float]
    accepted: list[bool]


SENSES = {"range_bearing": [0, 1], "range": [0], "bearing": [1]}


def textbook(
    source: MemorySource, steps: Ekf | Ukf, bias: Floats, gate: float, order: Clock
) -> Textbook:
    robot = {topic.rpartition("/")[2]: stream for topic, stream in source.streams.items()}
    places = dict(zip(robot["landmarks"]["landmark_id"], robot["landmarks"]["position_m"], strict=True))
    density = np.array(
        [float(robot["odometry"].metadata[f"{name}_noise_density"]) for name in ("forward", "turn")]
    )
    messages = sorted(
        (time_ns, position, name, row)
        for name in ("odometry", *SENSES)
        if name in robot
        for row, (time_ns, position) in enumerate(
            zip(clock(robot[name], order), robot[name].position, strict=True)
        )
    )
    x, p = robot["prior"]["mean"][0], robot["prior"]["covariance"][0].reshape(3, 3)
    now = robot["prior"].publish_time_ns[0]
    velocity = np.zeros(2)
    largest = [0.0, *chi2.ppf(gate, [1, 2])]
    result = Textbook([], [], [], [], [])
    for index, (time_ns, _, name, row) in enumerate(messages):
        duration = (time_ns - now) * 1e-9
        if duration > 0:
            noise = drive_noise(x, velocity, duration, density)
            x, p = steps.predict(x, p, velocity, duration)
            p, now = p + noise, time_ns
        if name == "odometry":
            velocity = np.array([robot[name]["forward_mps"][row], robot[name]["turn_radps"][row]])
        else:
            rows = SENSES[name]
            z, sigma = np.zeros(2), np.zeros(2)
            for k, quantity in enumerate(("range_m", "bearing_rad")):
                if k in rows:
                    z[k] = robot[name][quantity][row]
                    sigma[k] = float(robot[name].metadata[f"sigma_{quantity}"])
            place = places[robot[name]["target_id"][row]]
            v, s, c = steps.compare(x, p, place, z - bias)
            v, s, c = v[rows], (s + np.diag(sigma**2))[np.ix_(rows, rows)], c[:, rows]
            squared = v @ np.linalg.solve(s, v)
            accepted = squared <= largest[len(rows)]
            if accepted:
                gain = c @ np.linalg.inv(s)
                x, p = x + gain @ v, p - gain @ s @ gain.T
            result.squared.append(squared)
            result.accepted.append(accepted)
        if index + 1 == len(messages) or messages[index + 1][0] != time_ns:
            result.stamps.append(time_ns)
            result.means.append(np.array([x[0], x[1], wrap(x[2])]))
            result.covariances.append(p)
    return result


def clock(stream: Stream, order: Clock) -> NDArray[np.int64]:
    return stream.publish_time_ns if order == "publish_time" else stream.log_time_ns


RICH = {
    "duration_s": 12.0,
    "range_bearing": {"rate_hz": 5.0, "outlier_probability": 0.05, "bias_range_m": 0.2},
    "range": {"rate_hz": 3.0, "sigma_range_m": 0.3},
    "bearing": {"rate_hz": 7.0, "bias_bearing_rad": 0.03, "latency_s": 0.08},
}


@pytest.mark.paper
@pytest.mark.parametrize(
    ("name", "steps", "order"),
    [
        ("ekf", Ekf(), "publish_time"),
        ("ekf", Ekf(), "log_time"),
        ("ukf", Ukf(0.0), "log_time"),
        ("ukf", Ukf(0.7), "publish_time"),
    ],
)
def test_filters_equal_the_textbook(name: str, steps: Ekf | Ukf, order: Clock):
    """All sensors at once with outliers, biases, a gate and a latency, in either order of messages."""
    source = record(**RICH)
    settings = {"kappa": steps.kappa} if isinstance(steps, Ukf) else {}
    bias = {"bias_range_m": 0.2, "bias_bearing_rad": 0.03}
    ours = replayed(name, [source], order, **settings, **bias, gate_probability=0.99)
    book = textbook(source, steps, np.array([0.2, 0.03]), 0.99, order)
    pose, innovation = ours["pose"], ours["innovation"]
    np.testing.assert_array_equal(pose.stream.publish_time_ns, book.stamps)
    np.testing.assert_allclose(pose["mean"], book.means, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose["covariance"].reshape(-1, 3, 3), book.covariances, rtol=0, atol=1e-9)
    squared = innovation["normalised_innovation_squared"]
    np.testing.assert_allclose(squared, book.squared, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(innovation["accepted"], book.accepted)
    assert 8 < np.sum(innovation["accepted"] == 0) < 0.2 * len(squared)  # the gate has work to do


def changed(source: MemorySource, *streams: Stream) -> MemorySource:
    """The run with these streams in place of its own."""
    named = {**source.streams, **{stream.topic: stream for stream in streams}}
    return memory_source(Recording(list(named.values())), source.run)


@pytest.mark.parametrize("name", ["ekf", "ukf", "cooperative:joint"])
def test_a_map_in_any_order_is_the_same_map(name: str):
    """Landmarks are known by number, also in runs whose maps differ."""
    sources = [record(run, duration_s=5.0, robots=3) for run in range(2)]
    maps = [source.streams["/landmarks"] for source in sources]
    orders = [np.random.default_rng(seed).permutation(len(each)) for seed, each in enumerate(maps)]
    mixed = [
        changed(source, landmarks.take(order))
        for source, landmarks, order in zip(sources, maps, orders, strict=True)
    ]
    tidy, shuffled = replayed(name, sources)["pose"], replayed(name, mixed)["pose"]
    np.testing.assert_array_equal(tidy["mean"], shuffled["mean"])
    np.testing.assert_array_equal(tidy["covariance"], shuffled["covariance"])


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_landmark_seen_twice_in_one_look_is_two_measurements(name: str):
    """Both at once say what one with half the variance says, but for the second's linearisation."""
    source = record(duration_s=10.0)
    seen = source.streams["/robot1/range_bearing"]
    twice = changed(source, seen.take(np.repeat(np.arange(len(seen)), 2)))
    sigmas = {
        f"sigma_{each}": float(seen.metadata[f"sigma_{each}"]) for each in ("range_m", "bearing_rad")
    }
    halved = {key: sigma / np.sqrt(2) for key, sigma in sigmas.items()}
    double = replayed(name, [twice], gate_probability=1.0)
    single = replayed(name, [source], gate_probability=1.0, **halved)
    assert len(double["innovation"]) == 2 * len(single["innovation"])
    np.testing.assert_allclose(double["pose"]["mean"], single["pose"]["mean"], atol=5e-3)
    np.testing.assert_allclose(_spread(double), _spread(single), rtol=5e-3)
    assert np.all(_spread(replayed(name, [source], gate_probability=1.0)) > 1.15 * _spread(single))


def _spread(outputs: dict[str, Ragged]) -> Floats:
    """The standard deviations (3,) in the mean over the run."""
    covariance = outputs["pose"]["covariance"].reshape(-1, 3, 3)
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).mean(axis=0)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf"])
def test_a_landmark_on_the_very_spot_is_passed_over_and_counted(name: str):
    """Its bearing has no meaning and no derivative: it must not turn the heading."""
    source = record(duration_s=2.0)
    prior, seen = source.streams["/robot1/prior"], source.streams["/robot1/range_bearing"]
    landmarks = source.streams["/landmarks"]
    places = landmarks["position_m"].copy()
    places[landmarks["landmark_id"] == seen["target_id"][0]] = prior["mean"][0, :2]
    spot = replace(landmarks, columns={**landmarks.columns, "position_m": places})
    first = replace(seen.take(slice(0, 1)), publish_time_ns=prior.publish_time_ns[:1])
    others = {f"/robot1/{leaf}" for leaf in SENSES}
    kept = {topic: each for topic, each in source.streams.items() if topic not in others}
    ours = replayed(name, [changed(replace(source, streams=kept), spot, first)])
    pose = ours["pose"]
    assert pose.stream.publish_time_ns[0] == prior.publish_time_ns[0]
    np.testing.assert_array_equal(pose["mean"][0], prior["mean"][0])
    np.testing.assert_array_equal(pose["covariance"][0], prior["covariance"][0])
    assert ours["innovation"]["accepted"].tolist() == [0]
    assert INNOVATION.of(innovations_of(ours["innovation"]))["gated_share"] == 1.0


def test_dead_reckoning_is_the_prediction_alone():
    source = record(**RICH)
    blind = {
        topic: stream for topic, stream in source.streams.items() if topic.split("/")[-1] not in SENSES
    }
    book = textbook(replace(source, streams=blind), Ekf(), np.zeros(2), 0.5, "publish_time")
    pose = replayed("dead-reckoning", [source])["pose"]
    np.testing.assert_allclose(pose["mean"], book.means, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose["covariance"].reshape(-1, 3, 3), book.covariances, rtol=0, atol=1e-9)


def test_odometry_from_before_the_prior_still_drives():
    """The velocity read at 0 s holds at the prior of 1.02 s; the estimates begin with the prior."""
    source = record(duration_s=3.0, landmarks=0, odometry_rate_hz=1.0)
    prior = source.streams["/robot1/prior"]
    later = replace(prior, publish_time_ns=prior.publish_time_ns + 1_020_000_000)
    late = replace(source, streams={**source.streams, "/robot1/prior": later})
    pose = replayed("dead-reckoning", [late])["pose"]
    velocity = source.streams["/robot1/odometry"]["forward_mps"][0]
    moved = np.linalg.norm(pose["mean"][0, :2] - prior["mean"][0, :2])
    assert len(pose) == 1
    np.testing.assert_allclose(moved, 0.98 * velocity, rtol=1e-2)


# Honesty: 100 runs in which model and filter agree, and filters that are told wrong noise.


@pytest.fixture(scope="module")
def hundred_runs() -> list[MemorySource]:
    return [record(run, duration_s=20.0) for run in range(100)]


class Honesty(NamedTuple):
    """What 100 runs of 20 s say of a filter."""

    nees_at_steps: Floats
    nees_over_time: Floats
    nis: float
    degrees: int

    def is_consistent(self) -> bool:
        """Whether all three averages lie in their intervals, each of which holds 95 % of honest filters.

        The NEES of all runs at 10 steps, 2 s apart (chi-square, Bonferroni); the mean over the runs of
        each run's mean over time (the runs are independent, the times are not: Student); and the NIS of
        all innovations, which are independent if the filter is right (chi-square).
        """
        low, high = chi_square_interval(3, 100, 1 - 0.05 / len(self.nees_at_steps))
        margin = t.ppf(0.975, 99) * self.nees_over_time.std(ddof=1) / 10
        nis_low, nis_high = chi_square_interval(self.degrees, 1)
        return bool(
            np.all((low < self.nees_at_steps) & (self.nees_at_steps < high))
            and abs(self.nees_over_time.mean() - 3) < margin
            and nis_low < self.nis < nis_high
        )


def honesty(name: str, runs: list[MemorySource], **noise: float) -> Honesty:
    outputs = replayed(name, runs, gate_probability=1.0, **noise)
    errors = errors_of(outputs["pose"], [*map(Truths, runs)])
    assert isinstance(errors, Errors)
    nees = errors.nees.reshape(100, -1)
    innovations = innovations_of(outputs["innovation"])
    return Honesty(
        nees[:, 39::40].mean(axis=0),
        nees.mean(axis=1),
        float(innovations.squared.sum()),
        int(innovations.degrees.sum()),
    )


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_filters_that_know_the_noise_are_consistent(name: str, hundred_runs: list[MemorySource]):
    """They claim neither too much nor too little.

    Measured, EKF and UKF: NEES 2.97 and 2.96 +- .12 (3 is honest), at the steps 2.53 to 3.64 in
    [2.36, 3.73], NIS per component .9996 and .9995 in 1 +- .0064.
    """
    assert honesty(name, hundred_runs).is_consistent()


FIXES = {"rate_hz": 1.0, "sigma_m": 1.0, "outages_per_minute": 3.0, "outage_s": 5.0}


@cache
def runs_with_fixes(landmarks: str) -> list[MemorySource]:
    if landmarks == "landmarks":
        sensors = {"fix": {**FIXES, "origin_deg": (54.0, 12.0)}}
    else:
        sensors = {"fix": FIXES, "range_bearing": {"rate_hz": 0.0}}
    return [record(run, duration_s=20.5, **sensors) for run in range(100)]  # no fix at the very end


@pytest.mark.paper
@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize("landmarks", ["landmarks", "no landmarks"])
def test_filters_with_fixes_are_consistent(name: str, landmarks: str) -> None:
    """Odometry and fixes with outages, on earth and in the plane; see `Honesty`."""
    runs = runs_with_fixes(landmarks)
    assert not honesty(name, runs, forward_noise_density=0.05).is_consistent()
    assert honesty(name, runs).is_consistent()


@pytest.mark.paper
def test_a_robot_with_odometry_and_fixes_needs_no_prior() -> None:
    """It begins where its path fits the first fixes, and claims neither too much nor too little there.

    Measured: NEES 2.75 +- .14 over 100 runs of 60 s, of 2.88 +- .14 with the log's prior.
    """
    sensors = {"fix": FIXES, "range_bearing": {"rate_hz": 0.0}}
    recorded = [record(run, duration_s=40.0, **sensors) for run in range(100)]
    runs = [without(source, "/robot1/prior") for source in recorded]
    outputs = replayed("ekf", runs, gate_probability=1.0)
    reasons = sentences_of(outputs["started"].stream)
    assert set(reasons) == {
        "the log has no prior (/robot1/prior): the estimate starts where the path fits the first fixes"
    }
    assert len(reasons) == 100
    errors = errors_of(outputs["pose"], [*map(Truths, runs)])
    assert isinstance(errors, Errors)
    first = np.flatnonzero(np.diff(errors.run, prepend=-1))
    low, high = chi_square_interval(3, 100, 0.999)
    assert low < errors.nees[first].mean() < high
    assert np.sqrt(np.mean(errors.error[first, 2] ** 2)) < 0.12
    of_runs = np.array([errors.nees[errors.run == run].mean() for run in range(100)])
    assert abs(of_runs.mean() - 3) < t.ppf(0.995, 99) * of_runs.std(ddof=1) / 10


@pytest.mark.parametrize(
    "noise",
    [
        {"sigma_range_m": 0.09},
        {"sigma_bearing_rad": 0.022},
        {"forward_noise_density": 0.03},
        {"turn_noise_density": 0.008},
        {"bias_range_m": 0.02},
    ],
)
def test_filters_that_are_told_wrong_noise_are_not(
    noise: dict[str, float], hundred_runs: list[MemorySource]
):
    """The same check fails by a tenth of a sensor's sigma, and half or a fifth of the odometry's."""
    assert not honesty("ekf", hundred_runs, **noise).is_consistent()


# Failures: one run ends, the others do not notice.


def absurd(source: MemorySource) -> MemorySource:
    """The run with an odometry message, 5 s in, that is not left out, and no covariance survives it."""
    odometry = source.streams["/robot1/odometry"]
    forward = odometry["forward_mps"].copy()
    forward[100] = 1e200
    columns = {**odometry.columns, "forward_mps": forward}
    streams = {**source.streams, "/robot1/odometry": replace(odometry, columns=columns)}
    return replace(source, streams=streams, is_raw=True)


def onto_a_landmark(source: MemorySource) -> MemorySource:
    """The run with a prior exactly at the first landmark that it sees: a distance of zero."""
    first = source.streams["/robot1/range_bearing"]["target_id"][0]
    landmarks, prior = source.streams["/landmarks"], source.streams["/robot1/prior"]
    mean = prior["mean"].copy()
    mean[0, :2] = landmarks["position_m"][landmarks["landmark_id"] == first]
    columns = {**prior.columns, "mean": mean}
    return replace(source, streams={**source.streams, "/robot1/prior": replace(prior, columns=columns)})


@pytest.mark.parametrize("name", ["ekf", "ukf", "dead-reckoning"])
@pytest.mark.parametrize("break_run", [absurd, onto_a_landmark])
def test_a_failing_run_says_so_and_leaves_the_others_alone(
    name: str, break_run: Callable[[MemorySource], MemorySource]
):
    sources = [record(run, duration_s=10.0) for run in range(3)]
    broken = [sources[0], break_run(sources[1]), sources[2]]
    outputs = replayed(name, broken)
    for run in (0, 2):
        alone = replayed(name, [sources[run]])
        for leaf, ragged in outputs.items():
            assert_same_columns(ragged.of_run(run), alone[leaf].stream)
    failure, pose = outputs["failure"].of_run(1), outputs["pose"].of_run(1)
    fails = break_run is absurd  # the bearing has no derivative at a distance of zero: it counts as 0
    assert len(failure) == fails
    assert np.isfinite(pose["mean"]).all()
    if fails:
        assert np.all(pose.publish_time_ns < failure.publish_time_ns)
        assert failure["reason"][0] < len(json.loads(failure.metadata["reasons"]))


def assert_same_columns(ours: Stream, theirs: Stream) -> None:
    np.testing.assert_array_equal(ours.publish_time_ns, theirs.publish_time_ns)
    for name, column in ours.columns.items():
        np.testing.assert_array_equal(column, theirs.columns[name], strict=True)


# What does not fit is refused.


def without(source: MemorySource, topic: str) -> MemorySource:
    return replace(source, streams={k: v for k, v in source.streams.items() if k != topic})


def test_dead_reckoning_needs_no_map():
    source = record(duration_s=2.0)
    assert len(replayed("dead-reckoning", [without(source, "/landmarks")])["pose"]) == 40


def test_what_no_run_can_use_is_bad_input():
    source = record(duration_s=2.0)
    prior = source.streams["/robot1/prior"]
    flat = replace(prior, columns={**prior.columns, "covariance": np.zeros((1, 9))})
    none = prior.take(slice(0, 0))
    for stream, words in ((flat, "not positive definite"), (none, "no prior message")):
        with pytest.raises(BadInput, match=words):
            replayed("ekf", [replace(source, streams={**source.streams, "/robot1/prior": stream})])
    odometry = source.streams["/robot1/odometry"]
    for stated, words in (
        ({}, "does not state forward_noise_density, turn_noise_density; give them with --set"),
        (
            {"forward_noise_density": "nan"},
            "/robot1/odometry: parameter 'forward_noise_density' is nan; it should be a finite number",
        ),
    ):
        silent = {**source.streams, "/robot1/odometry": replace(odometry, metadata=stated)}
        with pytest.raises(BadInput, match=words):
            replayed("ekf", [replace(source, streams=silent)])
    landmarks = source.streams["/landmarks"]
    line = replace(
        landmarks, columns={**landmarks.columns, "position_m": landmarks["position_m"][:, :1]}
    )
    with pytest.raises(BadInput, match="topic /landmarks: position_m: the channel has no component x_m"):
        replayed("ekf", [replace(source, streams={**source.streams, "/landmarks": line})])
    for topic in ("/landmarks", "/robot1/range_bearing", "/robot1/prior", "/robot1/odometry"):
        said = f"run 0 of landmarks: .* ekf does not fit this log: model robot .* lacks .*{topic}"
        with pytest.raises(BadInput, match=rf"{said} .*; the log has /"):
            replayed("ekf", [without(source, topic)])
        foreign = replace(source.streams[topic], schema=schemas.SCAN)
        with pytest.raises(BadInput, match=f"{said} .*which has type fuselog.Scan in this log"):
            replayed("ekf", [replace(source, streams={**source.streams, topic: foreign})])
    with pytest.raises(BadInput, match="gives no valid covariance"):
        unscented(3, -3.0)
