"""How fast filters go through a log beside FilterPy and Stone Soup, measured side by side in one run.

The same log, models and noise for all; that the estimates are equal is asserted. Ours starts from
columns in memory and ends with the output streams, everything included; the peers get ready-made Python
numbers.
Needs the extra `bench`. Run it with `make bench`, or `python -m tests.bench filters`.
"""

import math
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, JulierSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray
from stonesoup.base import Property
from stonesoup.models.base import GaussianModel
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import UnscentedKalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import UnscentedKalmanUpdater

from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from tests.bench.timing import cpu_seconds

TOLERANCE = 1e-6
SIGMAS = np.array([0.1, 0.02])
DENSITIES = np.array([0.02, 0.01])
Floats = NDArray[np.float64]


class Row(NamedTuple):
    """One comparison, in messages per second of CPU time."""

    name: str
    ours: float
    theirs: float
    ratio: float


class Message(NamedTuple):
    """Odometry (no landmark; forward, turn), or a sighting of a landmark (range, bearing)."""

    time_ns: int
    landmark: tuple[float, float] | None
    value: tuple[float, float]


def main() -> list[Row]:
    """Measure: one log with every filter, then ensembles against the same peers' rate."""
    log = record(duration_s=300.0, run=0)
    messages, prior = as_messages(log)
    ways: dict[str, Callable[[], Any]] = {
        "ukf": partial(ours, "ukf", [log]),
        "ekf": partial(ours, "ekf", [log]),
        "filterpy ukf": partial(filterpy_ukf, messages, *prior),
        "filterpy ekf": partial(filterpy_ekf, messages, *prior),
        "stonesoup ukf": partial(stonesoup_ukf, messages, *prior),
    }
    results = {name: way() for name, way in ways.items()}  # compiles ours as well
    for kind in ("ukf", "ekf"):
        for name in ways:
            if name.endswith(f" {kind}"):
                apart = np.max(np.abs(results[name] - results[kind]))
                assert apart < TOLERANCE, f"{name} and ours are {apart} apart"
    rate = {name: len(messages) / taken for name, taken in cpu_seconds(ways).items()}
    rows = [
        row("UKF, one log; FilterPy", rate["ukf"], rate["filterpy ukf"]),
        row("UKF, one log; Stone Soup", rate["ukf"], rate["stonesoup ukf"]),
        row("EKF, one log; FilterPy", rate["ekf"], rate["filterpy ekf"]),
    ]
    for runs, duration_s in ((100, 60.0), (1000, 20.0)):
        logs = [record(duration_s, run) for run in range(runs)]
        count = sum(len(log.streams[topic]) for log in logs for topic in ODOMETRY_AND_SIGHTINGS)
        taken = cpu_seconds({kind: partial(ours, kind, logs) for kind in ("ukf", "ekf")})
        for kind in ("ukf", "ekf"):
            name = f"{kind.upper()}, {runs} runs together; FilterPy, one"
            rows.append(row(name, count / taken[kind], rate[f"filterpy {kind}"]))
    return rows


def row(name: str, ours: float, theirs: float) -> Row:
    return Row(name, ours, theirs, ours / theirs)


ODOMETRY_AND_SIGHTINGS = ("/robot1/odometry", "/robot1/range_bearing")


def record(duration_s: float, run: int) -> MemorySource:
    return memory_source(*record_run("landmarks", {"duration_s": duration_s}, 1, run))


def as_messages(log: MemorySource) -> tuple[list[Message], tuple[int, Floats, Floats]]:
    """The log as Python numbers in time order, and the prior's stamp, mean and covariance."""
    odometry, sightings = (log.streams[topic] for topic in ODOMETRY_AND_SIGHTINGS)
    landmarks = log.streams["/landmarks"]
    places = dict(
        zip(landmarks["landmark_id"].tolist(), map(tuple, landmarks["position_m"].tolist()), strict=True)
    )
    driven = zip(odometry["forward_mps"].tolist(), odometry["turn_radps"].tolist(), strict=True)
    seen = zip(sightings["range_m"].tolist(), sightings["bearing_rad"].tolist(), strict=True)
    messages = [
        Message(stamp, None, value)
        for stamp, value in zip(odometry.publish_time_ns.tolist(), driven, strict=True)
    ] + [
        Message(stamp, places[target], value)
        for stamp, target, value in zip(
            sightings.publish_time_ns.tolist(), sightings["target_id"].tolist(), seen, strict=True
        )
    ]
    positions = np.concatenate([odometry.position, sightings.position])
    stamps = np.array([message.time_ns for message in messages])
    prior = log.streams["/robot1/prior"]
    start = (int(prior.publish_time_ns[0]), prior["mean"][0], prior["covariance"][0].reshape(3, 3))
    return [messages[index] for index in np.lexsort((positions, stamps))], start


def ours(kind: str, logs: list[MemorySource]) -> Floats:
    """Poses (stamps, 3) of all runs; no gate, as the peers have none."""
    outputs = collect(replay(logs, bind(kind, logs, {"gate_probability": 1.0})))
    return outputs[f"/estimates/{kind}/robot1/pose"]["mean"]


# The models that the peers are given, in plain Python numbers.


def wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def drive(pose: Floats, duration_s: float, velocity: tuple[float, float]) -> Floats:
    half_turn = 0.5 * velocity[1] * duration_s
    chord = velocity[0] * duration_s * (math.sin(half_turn) / half_turn if half_turn else 1.0)
    direction = pose[2] + half_turn
    return np.array(
        [
            pose[0] + chord * math.cos(direction),
            pose[1] + chord * math.sin(direction),
            pose[2] + 2 * half_turn,
        ]
    )


def look(pose: Floats, landmark: tuple[float, float]) -> Floats:
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    return np.array([math.sqrt(dx * dx + dy * dy), wrap(math.atan2(dy, dx) - pose[2])])


def drive_by_heading_and_velocity(
    pose: Floats, duration_s: float, velocity: tuple[float, float]
) -> tuple[Floats, Floats]:
    """The Jacobians of `drive` by the pose (3, 3) and by the velocity (3, 2)."""
    half_turn = 0.5 * velocity[1] * duration_s
    ratio = math.sin(half_turn) / half_turn if half_turn else 1.0
    slope = (math.cos(half_turn) - ratio) / half_turn if half_turn else 0.0
    cosine, sine = math.cos(pose[2] + half_turn), math.sin(pose[2] + half_turn)
    length = velocity[0] * duration_s
    by_pose = np.array([[1, 0, -length * ratio * sine], [0, 1, length * ratio * cosine], [0, 0, 1]])
    by_velocity = duration_s * np.array(
        [
            [ratio * cosine, length / 2 * (slope * cosine - ratio * sine)],
            [ratio * sine, length / 2 * (slope * sine + ratio * cosine)],
            [0, 1],
        ]
    )
    return by_pose, by_velocity


def control_noise(by_velocity: Floats, duration_s: float) -> Floats:
    return (by_velocity * (DENSITIES**2 / duration_s)) @ by_velocity.T


def look_by_pose(pose: Floats, landmark: tuple[float, float]) -> Floats:
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    squared = dx * dx + dy * dy
    distance = math.sqrt(squared)
    return np.array([[-dx / distance, -dy / distance, 0], [dy / squared, -dx / squared, -1]])


def bearing_residual(first: Floats, second: Floats) -> Floats:
    difference = first - second
    difference[1] = wrap(difference[1])
    return difference


# FilterPy.


def filterpy_ukf(messages: list[Message], start_ns: int, mean: Floats, covariance: Floats) -> Floats:
    def look_mean(seen: Floats, weights: Floats) -> Floats:
        apart = seen - seen[0]
        apart[:, 1] = (apart[:, 1] + math.pi) % (2 * math.pi) - math.pi
        return seen[0] + weights @ apart

    points = JulierSigmaPoints(3, kappa=0.0)
    ukf = UnscentedKalmanFilter(
        3, 2, 1.0, look, drive, points, z_mean_fn=look_mean, residual_z=bearing_residual
    )
    ukf.x, ukf.P, ukf.R = mean.copy(), covariance.copy(), np.diag(SIGMAS**2)
    ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
    velocity, now_ns = (0.0, 0.0), start_ns
    poses = []
    for index, (time_ns, landmark, value) in enumerate(messages):
        if time_ns > now_ns:
            duration_s = (time_ns - now_ns) * 1e-9
            ukf.Q = control_noise(
                drive_by_heading_and_velocity(ukf.x, duration_s, velocity)[1], duration_s
            )
            ukf.predict(dt=duration_s, velocity=velocity)  # draws its points again itself
            now_ns = time_ns
        if landmark is None:
            velocity = value
        else:
            ukf.update(np.array(value), landmark=landmark)
            ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
        if is_last(messages, index):
            poses.append(ukf.x)
    return wrapped_heading(poses)


def filterpy_ekf(messages: list[Message], start_ns: int, mean: Floats, covariance: Floats) -> Floats:
    class Robot(ExtendedKalmanFilter):
        def predict_x(self, u: tuple[float, tuple[float, float]]) -> None:
            self.x = drive(self.x, *u)

    ekf = Robot(3, 2)
    ekf.x, ekf.P, ekf.R = mean.copy(), covariance.copy(), np.diag(SIGMAS**2)
    velocity, now_ns = (0.0, 0.0), start_ns
    poses = []
    for index, (time_ns, landmark, value) in enumerate(messages):
        if time_ns > now_ns:
            duration_s = (time_ns - now_ns) * 1e-9
            ekf.F, by_velocity = drive_by_heading_and_velocity(ekf.x, duration_s, velocity)
            ekf.Q = control_noise(by_velocity, duration_s)
            ekf.predict((duration_s, velocity))
            now_ns = time_ns
        if landmark is None:
            velocity = value
        else:
            arguments = {"args": (landmark,), "hx_args": (landmark,)}
            ekf.update(np.array(value), look_by_pose, look, residual=bearing_residual, **arguments)
        if is_last(messages, index):
            poses.append(ekf.x)
    return wrapped_heading(poses)


# Stone Soup: its models know the time but neither odometry nor map, so they are told before each step.


class Driving(TransitionModel, GaussianModel):
    """The arc; `velocity` and `noise` hold for the next prediction."""

    velocity: tuple[float, float] = Property(default=(0.0, 0.0))
    noise: Floats = Property(default=None)
    ndim_state = 3

    def function(self, state: Any, _noise: Any = None, *, time_interval: timedelta, **_rest: Any) -> Any:  # noqa: D102
        x, y, heading = state.state_vector.view(np.ndarray)
        moved = state.state_vector.copy()
        half_turn = 0.5 * self.velocity[1] * time_interval.total_seconds()
        chord = self.velocity[0] * time_interval.total_seconds()
        chord *= math.sin(half_turn) / half_turn if half_turn else 1.0
        moved[0] = x + chord * np.cos(heading + half_turn)
        moved[1] = y + chord * np.sin(heading + half_turn)
        moved[2] = heading + 2 * half_turn
        return moved

    def covar(self, **_: Any) -> Floats:  # noqa: D102
        return self.noise


class Looking(MeasurementModel, GaussianModel):
    """Range and bearing to `landmark`, as plain numbers near the measured `bearing`."""

    landmark: tuple[float, float] = Property(default=None)
    bearing: float = Property(default=None)
    ndim_state, ndim_meas = 3, 2
    mapping = (0, 1, 2)

    def function(self, state: Any, _noise: Any = None, **_rest: Any) -> Any:  # noqa: D102
        x, y, heading = state.state_vector.view(np.ndarray)
        dx, dy = self.landmark[0] - x, self.landmark[1] - y
        seen = state.state_vector[:2].copy()
        seen[0] = np.sqrt(dx * dx + dy * dy)
        apart = np.arctan2(dy, dx) - heading - self.bearing
        seen[1] = self.bearing + (apart + math.pi) % (2 * math.pi) - math.pi
        return seen

    def covar(self, **_: Any) -> Floats:  # noqa: D102
        return np.diag(SIGMAS**2)


def stonesoup_ukf(messages: list[Message], start_ns: int, mean: Floats, covariance: Floats) -> Floats:
    epoch = datetime(2026, 1, 1)
    driving = Driving()
    looking = Looking()
    spread = {"alpha": 1.0, "beta": 0.0, "kappa": 0.0}  # Julier's points, as ours
    predictor = UnscentedKalmanPredictor(driving, **spread)
    updater = UnscentedKalmanUpdater(looking, **spread)
    state = GaussianState(mean[:, None], covariance, timestamp=epoch)
    now_ns = start_ns
    poses = []
    for index, (time_ns, landmark, value) in enumerate(messages):
        stamp = epoch + timedelta(microseconds=(time_ns - start_ns) / 1000)
        if time_ns > now_ns:
            duration_s = (time_ns - now_ns) * 1e-9
            pose = np.asarray(state.state_vector, float)[:, 0]
            by_velocity = drive_by_heading_and_velocity(pose, duration_s, driving.velocity)[1]
            driving.noise = control_noise(by_velocity, duration_s)
            state = predictor.predict(state, timestamp=stamp)
            now_ns = time_ns
        if landmark is None:
            driving.velocity = value
        else:
            looking.landmark, looking.bearing = landmark, value[1]
            detection = Detection(np.array(value)[:, None], timestamp=stamp)
            state = updater.update(SingleHypothesis(state, detection))
        if is_last(messages, index):
            poses.append(np.asarray(state.state_vector, float)[:, 0])
    return wrapped_heading(poses)


def is_last(messages: list[Message], index: int) -> bool:
    return index + 1 == len(messages) or messages[index + 1].time_ns != messages[index].time_ns


def wrapped_heading(poses: list[Floats]) -> Floats:
    stacked = np.array(poses)
    stacked[:, 2] = (stacked[:, 2] + math.pi) % (2 * math.pi) - math.pi
    return stacked


if __name__ == "__main__":
    for line in main():
        print(*line)
