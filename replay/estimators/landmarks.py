"""Localization of robots in the plane from odometry and sightings of mapped landmarks.

Dead reckoning, the extended and the unscented Kalman filter. The state is (x_m, y_m, heading_rad); the
odometry's velocity holds until the next one. Ranges, bearings and range-bearings are one kind of event
whose missing component is NaN.
"""

import copy
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Schema, make_stream, schemas
from recorders.log.reader import Topic
from recorders.models.planar import (
    drive,
    drive_jacobians,
    range_bearing,
    range_bearing_jacobian,
    wrap_angle,
)
from recorders.parameters import Parameters
from replay.blocks import Block, Ragged
from replay.compile import compile_over_runs
from replay.engine import Bound, Estimator, Recursive
from replay.estimators.gaussian import (
    Filter,
    Floats,
    Function,
    Models,
    correct,
    linearised,
    sampled,
    unscented_points,
)

SENSORS = ("range_bearing", "range", "bearing")
FAILURES = ("the covariance is no longer positive definite", "the estimate is no longer finite")


class DeadReckoningParameters(Parameters):
    """Noise densities are per square root of a second; None takes what the log's channels state."""

    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None


class LocalizationParameters(DeadReckoningParameters):
    """Sensor noise and bias, and how improbable a measurement must be to be kept out."""

    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    bias_range_m: float = 0.0
    bias_bearing_rad: float = 0.0
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


class UnscentedParameters(LocalizationParameters):
    """The unscented filter's spread: 3 - n is Julier's choice for a Gaussian."""

    kappa: float = 0.0


class Carried(NamedTuple):
    """What a filter carries from block to block; first axis = run. `failure` is -1 while all is well."""

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: NDArray[np.int64]
    failure: NDArray[np.int64]


class Landmarks(NamedTuple):
    """The maps of all runs end to end: keys are run * 2^32 + landmark, sorted; positions (n, 2)."""

    keys: NDArray[np.int64]
    positions: Floats


class Settings(NamedTuple):
    """What the filter is told.

    Densities (2,) of the control, variance and bias (sensors, 2), the gate by the number of measured
    components (3,), and the samples of a sampled filter.
    """

    control_density: Floats
    variance: Floats
    bias: Floats
    gate: Floats
    points: Floats
    weights: Floats


class Sightings(NamedTuple):
    """The events of all runs in order.

    Odometry has sensor -1 and value (forward, turn); a sighting has value (range, bearing) and, as
    target, the row of its target on the map, -1 if it is not there.

    `emit` and `diagnose` say which row of the output an event fills, -1 for none.
    """

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    sensor: NDArray[np.int64]
    value: Floats
    target: NDArray[np.int64]
    emit: NDArray[np.int64]
    diagnose: NDArray[np.int64]


class Results(NamedTuple):
    """What the kernel fills; NaN where a run failed before."""

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats
    accepted: NDArray[np.int64]


def fill_motion_jacobians(
    pose: Floats, velocity: Floats, duration_s: float, transition: Floats, gain: Floats
) -> None:
    """The Jacobians of `drive` by the pose (3, 3) and by the velocity (3, 2)."""
    by_heading, by_forward, by_turn = drive_jacobians(pose, velocity, duration_s)
    transition[:] = 0.0
    gain[:] = 0.0
    for row in range(2):
        transition[row, row] = 1.0
        transition[row, 2] = by_heading[row]
        gain[row, 0] = by_forward[row]
        gain[row, 1] = by_turn[row]
    transition[2, 2] = 1.0
    gain[2, 1] = duration_s


def fill_sensor_jacobian(pose: Floats, target: Floats, rows: Floats) -> None:
    """The Jacobian of `range_bearing` by the pose (2, 3)."""
    by_range, by_bearing = range_bearing_jacobian(pose, target)
    for column in range(3):
        rows[0, column] = by_range[column]
        rows[1, column] = by_bearing[column]


MODELS = Models(drive, fill_motion_jacobians, range_bearing, fill_sensor_jacobian, (False, True))


def localization(steps: Filter) -> Function:
    """The loop over the events of one run, specialised to a filter; changes `carried` in place."""
    predict, innovate = steps

    def localize(
        run: int,
        events: Sightings,
        positions: Floats,
        settings: Settings,
        carried: Carried,
        results: Results,
    ) -> None:
        mean, covariance = carried.mean[run], carried.covariance[run]
        velocity = carried.velocity[run]
        measured, innovation = np.empty(2), np.empty(2)
        innovation_covariance, cross_covariance = np.empty((2, 2)), np.empty((3, 2))
        control_variance = np.empty(2)
        for event in range(events.offsets[run], events.offsets[run + 1]):
            duration_s = (events.time_ns[event] - carried.time_ns[run]) * 1e-9
            if carried.failure[run] >= 0 or duration_s < 0.0:
                continue  # failed, or before the prior
            if duration_s > 0.0:
                # white noise on the velocity: its mean over a time T has variance density^2 / T
                for k in range(2):
                    control_variance[k] = settings.control_density[k] ** 2 / duration_s
                if not predict(
                    mean,
                    covariance,
                    velocity,
                    control_variance,
                    duration_s,
                    settings.points,
                    settings.weights,
                ):
                    carried.failure[run] = 0
                    continue
                carried.time_ns[run] = events.time_ns[event]
            sensor = events.sensor[event]
            if sensor < 0:
                velocity[0], velocity[1] = events.value[event, 0], events.value[event, 1]
            elif events.target[event] >= 0:
                for k in range(2):
                    measured[k] = events.value[event, k] - settings.bias[sensor, k]
                used = innovate(
                    mean,
                    covariance,
                    positions[events.target[event]],
                    measured,
                    settings.variance[sensor],
                    settings.points,
                    settings.weights,
                    innovation,
                    innovation_covariance,
                    cross_covariance,
                )
                if used < 0:
                    carried.failure[run] = 0
                    continue
                squared, accepted = correct(
                    mean,
                    covariance,
                    innovation,
                    innovation_covariance,
                    cross_covariance,
                    used,
                    settings.gate,
                )
                row = events.diagnose[event]
                results.squared[row] = squared
                results.accepted[row] = accepted
                first = 1 if np.isnan(measured[0]) else 0
                for i in range(used):
                    results.innovation[row, first + i] = innovation[i]
                    for j in range(used):
                        results.innovation_covariance[row, first + i, first + j] = innovation_covariance[
                            i, j
                        ]
            if not np.isfinite(mean.sum()):
                carried.failure[run] = 1
            elif events.emit[event] >= 0:
                results.mean[events.emit[event]] = mean
                results.covariance[events.emit[event]] = covariance

    return localize


@lru_cache(maxsize=8)
def _compiled(kind: str) -> Function:
    makers = {"linearised": linearised, "sampled": sampled}
    return compile_over_runs(localization(makers[kind](MODELS)))


def start(whole: Mapping[str, Ragged], prior_topic: str) -> tuple[Carried, Landmarks]:
    """The state at every run's prior, and the maps.

    Raises BadInput where a run has no prior, or one that is no pose with a positive definite covariance.
    """
    prior = whole[prior_topic]
    rows = prior.offsets[:-1]
    if np.any(np.diff(prior.offsets) == 0):
        raise BadInput(f"topic {prior_topic}: a run has no prior message; the filter cannot start")
    mean = prior["mean"][rows]
    if mean.shape[1] != 3 or prior["covariance"].shape[1] != 9:
        raise BadInput(f"topic {prior_topic}: a prior of (x_m, y_m, heading_rad) is needed")
    covariance = prior["covariance"][rows].reshape(-1, 3, 3)
    if np.any(np.linalg.eigvalsh(covariance)[:, 0] <= 0):
        raise BadInput(f"topic {prior_topic}: the prior's covariance is not positive definite")
    carried = Carried(
        mean,
        covariance,
        np.zeros((prior.runs, 2)),
        prior.stream.publish_time_ns[rows],
        np.full(prior.runs, -1),
    )
    return carried, _landmarks(whole["/landmarks"])


def _landmarks(landmarks: Ragged) -> Landmarks:
    run = np.repeat(np.arange(landmarks.runs), np.diff(landmarks.offsets))
    keys = (run << 32) + landmarks["landmark_id"]
    order = np.argsort(keys, kind="stable")
    positions = landmarks["position_m"].reshape(len(keys), -1)[:, :2]
    return Landmarks(keys[order], np.ascontiguousarray(positions[order]))


def run(
    state: tuple[Carried, Landmarks],
    block: Block,
    *,
    kind: str,
    settings: Settings,
    outputs: "Outputs",
) -> tuple[tuple[Carried, Landmarks], list[Ragged]]:
    """Filter a block; see `replay.engine.Recursive`."""
    before, landmarks = state
    carried = copy.deepcopy(before)
    events, target_id = _sightings(block, landmarks, carried.time_ns)
    results = _blank_results(events)
    _compiled(kind)(len(carried.mean), events, landmarks.positions, settings, carried, results)
    return (carried, landmarks), outputs.of(events, target_id, results, before, carried)


def _sightings(
    block: Block, landmarks: Landmarks, start_ns: NDArray[np.int64]
) -> tuple[Sightings, NDArray[np.int64]]:
    """The block's events as columns, and the targets' numbers (0 for odometry)."""
    order = block.events
    count = len(order.row)
    value = np.full((count, 2), np.nan)
    target_id = np.zeros(count, np.int64)
    for index, ragged in enumerate(block.streams.values()):
        at = order.topic == index
        row = order.row[at]
        names = ("forward_mps", "turn_radps") if index == 0 else ("range_m", "bearing_rad")
        for column, name in enumerate(names):
            if name in ragged.stream.columns:
                value[at, column] = ragged[name][row]
        if index > 0:
            target_id[at] = ragged["target_id"][row]
    run_of = np.repeat(np.arange(len(order.offsets) - 1), np.diff(order.offsets))
    sensor = order.topic - 1
    target = rows_on_map(landmarks, (run_of << 32) + target_id)
    started = order.time_ns >= start_ns[run_of]
    seen = (sensor >= 0) & (target >= 0) & started
    return Sightings(
        order.offsets,
        order.time_ns,
        sensor,
        value,
        target,
        _numbered(order.is_last & started),
        _numbered(seen),
    ), target_id


def rows_on_map(landmarks: Landmarks, keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows of the map that keys (run * 2^32 + landmark) have, -1 where it lacks them."""
    if len(landmarks.keys) == 0:
        return np.full(len(keys), -1)
    rows = np.minimum(np.searchsorted(landmarks.keys, keys), len(landmarks.keys) - 1)
    return np.where(landmarks.keys[rows] == keys, rows, -1)


def _numbered(chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """0, 1, 2, ... where chosen, -1 elsewhere."""
    return np.where(chosen, np.cumsum(chosen) - 1, -1)


def _blank_results(events: Sightings) -> Results:
    estimates = int(events.emit.max(initial=-1)) + 1
    looks = int(events.diagnose.max(initial=-1)) + 1
    return Results(
        np.full((estimates, 3), np.nan),
        np.full((estimates, 3, 3), np.nan),
        np.full((looks, 2), np.nan),
        np.full((looks, 2, 2), np.nan),
        np.full(looks, np.nan),
        np.zeros(looks, np.int64),
    )


class Outputs(NamedTuple):
    """The output topics of one bound filter, and how results become their streams."""

    name: str
    truth: str

    def of(
        self,
        events: Sightings,
        target_id: NDArray[np.int64],
        results: Results,
        before: Carried,
        after: Carried,
    ) -> list[Ragged]:
        """The estimates at every distinct stamp, the innovations, and the failures of this block."""
        at = events.emit >= 0
        valid = np.isfinite(results.mean[:, 0])
        mean = results.mean[valid]
        mean[:, 2] = wrap_angle(mean[:, 2])
        estimates = self._ragged(
            "pose",
            schemas.GAUSSIAN_ESTIMATE,
            events,
            np.flatnonzero(at)[valid],
            {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
            mean=mean,
            covariance=results.covariance[valid].reshape(-1, 9),
        )
        looks = np.flatnonzero(events.diagnose >= 0)
        done = np.isfinite(results.squared)
        innovations = self._ragged(
            "innovation",
            schemas.INNOVATION,
            events,
            looks[done],
            {"components": "range_m,bearing_rad", "kinds": "linear,angle"},
            target_id=target_id[looks[done]],
            accepted=results.accepted[done],
            innovation=results.innovation[done],
            covariance=results.innovation_covariance[done].reshape(-1, 4),
            normalised_innovation_squared=results.squared[done],
        )
        failed = np.flatnonzero((after.failure >= 0) & (before.failure < 0))
        offsets = np.searchsorted(failed, np.arange(len(after.failure) + 1))
        failure = make_stream(
            f"/estimates/{self.name}/failure",
            schemas.FAILURE,
            after.time_ns[failed],
            metadata={"reasons": "; ".join(FAILURES)},
            reason=after.failure[failed],
        )
        return [estimates, innovations, Ragged(failure, offsets)]

    def _ragged(
        self,
        leaf: str,
        schema: Schema,
        events: Sightings,
        at: NDArray[np.int64],
        metadata: Mapping[str, str],
        **columns: NDArray[Any],
    ) -> Ragged:
        stream = make_stream(
            f"/estimates/{self.name}/{leaf}",
            schema,
            events.time_ns[at],
            metadata={**metadata, "truth": self.truth},
            **columns,
        )
        return Ragged(stream, np.searchsorted(at, events.offsets))


def stated(topic: Topic, name: str, given: float | None) -> float:
    """A parameter as given, else as the channel's metadata states it."""
    if given is not None:
        return given
    try:
        return float(topic.metadata[name])
    except (KeyError, ValueError):
        raise BadInput(
            f"topic {topic.name} does not state {name}; give it with --set {name}=..."
        ) from None


def _bind(
    name: str,
    topics: Mapping[str, Topic],
    parameters: DeadReckoningParameters,
    *,
    kind: str,
    points: Floats,
    weights: Floats,
) -> list[Bound]:
    """One filter for every robot that has odometry, a prior and, unless it only reckons, a sensor."""
    bound: list[Bound] = []
    for topic in topics.values():
        prefix, _, leaf = topic.name.rpartition("/")
        if leaf != "odometry" or topic.schema_name != schemas.ODOMETRY.full_name:
            continue
        sensed: list[str] = []
        if isinstance(parameters, LocalizationParameters):
            sensed = [f"{prefix}/{sensor}" for sensor in SENSORS if f"{prefix}/{sensor}" in topics]
        if f"{prefix}/prior" not in topics or "/landmarks" not in topics:
            continue
        if isinstance(parameters, LocalizationParameters) and not sensed:
            continue
        settings = _settings(topics, topic, sensed, parameters, points, weights)
        bound.append(
            Recursive(
                f"{name}{prefix}",
                (topic.name, *sensed),
                (f"{prefix}/prior", "/landmarks"),
                partial(start, prior_topic=f"{prefix}/prior"),
                partial(
                    run,
                    kind=kind,
                    settings=settings,
                    outputs=Outputs(f"{name}{prefix}", f"{prefix}/truth"),
                ),
            )
        )
    return bound


def _settings(
    topics: Mapping[str, Topic],
    odometry: Topic,
    sensed: list[str],
    parameters: DeadReckoningParameters,
    points: Floats,
    weights: Floats,
) -> Settings:
    density = [
        stated(odometry, "forward_noise_density", parameters.forward_noise_density),
        stated(odometry, "turn_noise_density", parameters.turn_noise_density),
    ]
    variance = np.full((len(sensed), 2), np.nan)
    bias = np.zeros(2)
    gate = np.full(3, np.inf)
    if isinstance(parameters, LocalizationParameters):
        for row, topic in enumerate(sensed):
            if not topic.endswith("/bearing"):
                sigma = stated(topics[topic], "sigma_range_m", parameters.sigma_range_m)
                variance[row, 0] = sigma**2
            if not topic.endswith("/range"):
                sigma = stated(topics[topic], "sigma_bearing_rad", parameters.sigma_bearing_rad)
                variance[row, 1] = sigma**2
        bias = np.array([parameters.bias_range_m, parameters.bias_bearing_rad])
        gate[1:] = chi2.ppf(parameters.gate_probability, [1, 2])
    return Settings(np.array(density), variance, np.tile(bias, (len(sensed), 1)), gate, points, weights)


def _bind_linearised(
    name: str, topics: Mapping[str, Topic], parameters: DeadReckoningParameters
) -> list[Bound]:
    none = np.empty((0, 3))
    return _bind(name, topics, parameters, kind="linearised", points=none, weights=none[:, 0])


def _bind_unscented(
    name: str, topics: Mapping[str, Topic], parameters: UnscentedParameters
) -> list[Bound]:
    points, weights = unscented_points(3, parameters.kappa)
    return _bind(name, topics, parameters, kind="sampled", points=points, weights=weights)


DEAD_RECKONING = Estimator(
    "robot pose from odometry alone",
    "/landmarks and, per robot, .../odometry and .../prior",
    DeadReckoningParameters,
    _bind_linearised,
)
EKF = Estimator(
    "robot pose from odometry and mapped landmarks, extended Kalman filter",
    "/landmarks and, per robot, .../odometry, .../prior and one of .../range_bearing, range, bearing",
    LocalizationParameters,
    _bind_linearised,
)
UKF = Estimator(
    "robot pose from odometry and mapped landmarks, unscented Kalman filter",
    EKF.needs,
    UnscentedParameters,
    _bind_unscented,
)
