"""Localization of robots in the plane from odometry and sightings of mapped landmarks.

Dead reckoning, the extended and the unscented Kalman filter. The state is (x_m, y_m, heading_rad); the
odometry's velocity holds until the next one. Ranges, bearings and range-bearings are one kind of event
whose missing component is NaN.
"""

import copy
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Schema, Topic, make_stream, schemas
from recorders.models.planar import (
    Components,
    drive,
    drive_jacobians,
    range_bearing,
    range_bearing_jacobian,
    wrap_angle,
)
from recorders.parameters import Parameters
from replay.blocks import Block, Ragged, filled_rows, of_runs, ragged_rows
from replay.compile import compile_over_runs
from replay.engine import Bound, Estimator, Recursive
from replay.estimators.gaussian import (
    ALL_WELL,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    Filter,
    Floats,
    Function,
    Innovation,
    Models,
    correct,
    failures_of,
    is_finite,
    linearised,
    no_innovation,
    sampled,
)
from replay.measurements import PLANE, read_vectors
from replay.priors import gaussians
from replay.sampling import Sampler, Sampling
from replay.sampling.names import Unscented
from replay.sampling.samplers import no_samples
from replay.sampling.sets import Generators, SampleSets, seeded_by_data, sets_by_runs
from replay.tangent import Kind

USES = 2  # of samples per event: prediction and update
POSE: dict[str, Kind] = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}
SENSORS = {
    "range_bearing": schemas.RANGE_BEARING,
    "range": schemas.RANGE,
    "bearing": schemas.BEARING,
}


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
    """What a filter carries from block to block; first axis = run."""

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

    Noise densities (2,) of the velocity, the sensors' bias (2,) and variances (sensors, 2), and the
    gate by the number of measured components (3,).
    """

    velocity_density: Floats
    bias: Floats
    variance: Floats
    gate: Floats


class Sightings(NamedTuple):
    """The events of all runs in order.

    Odometry has sensor -1 and value (forward, turn); a sighting has value (range, bearing), less bias
    and NaN where the sensor has none. `target` is the row of its target on the map, -1 for none.
    """

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    sensor: NDArray[np.int64]
    value: Floats
    target_id: NDArray[np.int64]
    target: NDArray[np.int64]
    is_last: NDArray[np.bool_]


class Poses(NamedTuple):
    """The estimates, as the kernel notes them; run r has room for rows offsets[r]:offsets[r + 1].

    It has filled those before `end[r]`. `event` says which event a row is of.
    """

    offsets: NDArray[np.int64]
    end: NDArray[np.int64]
    event: NDArray[np.int64]
    mean: Floats
    covariance: Floats


class Looks(NamedTuple):
    """The innovations, as the kernel notes them; see `Poses`."""

    offsets: NDArray[np.int64]
    end: NDArray[np.int64]
    event: NDArray[np.int64]
    difference: Floats
    covariance: Floats
    squared: Floats
    accepted: NDArray[np.int64]


def fill_motion_jacobians(
    pose: Components, velocity: Components, duration_s: float, transition: Floats, gain: Floats
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


def fill_sensor_jacobian(pose: Components, target: Components, rows: Floats) -> None:
    """The Jacobian of `range_bearing` by the pose (2, 3)."""
    by_range, by_bearing = range_bearing_jacobian(pose, target)
    for column in range(3):
        rows[0, column] = by_range[column]
        rows[1, column] = by_bearing[column]


MODELS = Models(3, drive, fill_motion_jacobians, range_bearing, fill_sensor_jacobian, (False, True))


def note_pose(poses: Poses, run: int, event: int, mean: Floats, covariance: Floats) -> None:
    """Fill the next row of a run's poses."""
    row = poses.end[run]
    poses.event[row] = event
    for i in range(3):
        poses.mean[row, i] = mean[i]
        for j in range(3):
            poses.covariance[row, i, j] = covariance[i, j]
    poses.end[run] = row + 1


def note_look(looks: Looks, run: int, event: int, innovation: Innovation) -> int:
    """Begin the next row of a run's looks, and return it; it counts when `end` is moved."""
    row = looks.end[run]
    looks.event[row] = event
    for i in range(2):
        looks.difference[row, i] = innovation.difference[i]
        for j in range(2):
            missing = np.isnan(innovation.difference[i] + innovation.difference[j])
            looks.covariance[row, i, j] = np.nan if missing else innovation.covariance[i, j]
    return row


def localization(steps: Filter) -> Function:
    """The loop over the events of one run, specialised to a filter."""
    _, predict, innovate = steps

    def take_in(
        run: int,
        event: int,
        events: Sightings,
        positions: Floats,
        settings: Settings,
        carried: Carried,
        looks: Looks,
        scratch: tuple[Innovation, Any],
    ) -> int:
        """Predict to one event and update by it; returns what failed, ALL_WELL where nothing did."""
        mean, covariance, velocity = carried.mean[run], carried.covariance[run], carried.velocity[run]
        sensor, target, value = events.sensor[event], events.target[event], events.value[event]
        innovation, memory = scratch
        duration_s = (events.time_ns[event] - carried.time_ns[run]) * 1e-9
        if duration_s > 0.0:
            carried.time_ns[run] = events.time_ns[event]
            if not predict(
                mean, covariance, velocity, settings.velocity_density, duration_s, event, memory
            ):
                return NOT_POSITIVE_DEFINITE
        if sensor < 0:
            velocity[0], velocity[1] = value[0], value[1]
        elif target >= 0 and duration_s >= 0.0:
            variance = settings.variance[sensor]
            if not innovate(
                mean, covariance, positions[target], value, variance, innovation, event, memory
            ):
                return NOT_POSITIVE_DEFINITE
            row = note_look(looks, run, event, innovation)
            squared, accepted = correct(mean, covariance, innovation, settings.gate)
            if np.isnan(squared):
                return NOT_POSITIVE_DEFINITE
            looks.squared[row], looks.accepted[row] = squared, accepted
            looks.end[run] = row + 1
        return ALL_WELL if is_finite(mean, covariance) else NOT_FINITE

    def localize(
        run: int,
        events: Sightings,
        positions: Floats,
        settings: Settings,
        carried: Carried,
        poses: Poses,
        looks: Looks,
        scratch: tuple[Innovation, Any],
    ) -> None:
        """Move what is carried, and fill poses and looks, until the events end or the filter fails."""
        start_ns = carried.time_ns[run]
        for event in range(events.offsets[run], events.offsets[run + 1]):
            if carried.failure[run] != ALL_WELL:
                break
            carried.failure[run] = take_in(
                run, event, events, positions, settings, carried, looks, scratch
            )
            due = events.is_last[event] and events.time_ns[event] >= start_ns
            if due and carried.failure[run] == ALL_WELL:
                note_pose(poses, run, event, carried.mean[run], carried.covariance[run])

    return localize


State = tuple[Carried, Landmarks, Generators]


@lru_cache(maxsize=8)
def _compiled(kind: str) -> tuple[Function, Function]:
    """The loop over the runs, and what makes the filter's memory."""
    steps = {"linearised": linearised, "sampled": sampled}[kind](MODELS)
    return compile_over_runs(localization(steps), allocates=False), steps.memory


def start(whole: Mapping[str, Ragged], prior_topic: str) -> State:
    """The state at every run's prior, and the maps; raises BadInput where the map is not planar."""
    time_ns, mean, covariance = gaussians(whole[prior_topic])
    runs = len(mean)
    carried = Carried(mean, covariance, np.zeros((runs, 2)), time_ns, np.full(runs, ALL_WELL))
    return carried, map_of_runs(whole.get("/landmarks")), (None,) * runs


def map_of_runs(landmarks: Ragged | None) -> Landmarks:
    """The maps of all runs from their topic, empty without one; raises BadInput unless planar."""
    if landmarks is None:
        return Landmarks(np.empty(0, np.int64), np.empty((0, 2)))
    positions = landmarks["position_m"]
    if len(landmarks) and positions.shape[1] < 2:
        raise BadInput("topic /landmarks: positions in the plane need two coordinates")
    run = np.repeat(np.arange(landmarks.runs), np.diff(landmarks.offsets))
    keys = (run << 32) + landmarks["landmark_id"]
    order = np.argsort(keys, kind="stable")
    return Landmarks(keys[order], read_vectors(landmarks.stream, "position_m", PLANE)[order])


def run(
    state: State,
    block: Block,
    *,
    kind: str,
    sampler: Sampler,
    seed: int,
    settings: Settings,
    outputs: "Outputs",
) -> tuple[State, list[Ragged]]:
    """Filter a block; see `replay.engine.Recursive`."""
    before, landmarks, generators = state
    carried = copy.deepcopy(before)
    events = _sightings(block, landmarks, settings.bias)
    started = events.time_ns >= np.repeat(before.time_ns, np.diff(events.offsets))
    poses = _no_poses(ragged_rows(events.is_last & started, events.offsets))
    looks = _no_looks(ragged_rows((events.target >= 0) & started, events.offsets))
    loop, memory = _compiled(kind)
    if sampler.redrawn:
        generators = seeded_by_data(generators, before.mean, np.arange(len(before.mean) + 1), seed)
    for runs, sets in sets_by_runs(sampler, generators, USES * events.offsets):
        loop(
            runs.stop - runs.start,
            events._replace(offsets=events.offsets[runs.start : runs.stop + 1]),
            landmarks.positions,
            settings,
            of_runs(carried, runs),
            poses._replace(end=poses.end[runs]),
            looks._replace(end=looks.end[runs]),
            scratch=partial(_scratch, memory, sets),
        )
    return (carried, landmarks, generators), [
        outputs.poses(poses, events),
        outputs.innovations(looks, events),
        failures_of(f"/estimates/{outputs.name}", before.failure, carried.failure, carried.time_ns),
    ]


def _scratch(memory: Function, sets: SampleSets) -> tuple[Innovation, Any]:
    return no_innovation(3, 2), memory(3, 2, 2, sets)


def _sightings(block: Block, landmarks: Landmarks, bias: Floats) -> Sightings:
    offsets, time_ns, topic, _, is_last = block.events
    sensor = topic - 1
    value = np.stack(
        [block.column("forward_mps", "range_m"), block.column("turn_radps", "bearing_rad")], axis=1
    )
    value -= np.where(sensor[:, None] >= 0, bias, 0.0)
    target_id = block.column("target_id", missing=0).astype(np.int64)
    run_of = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    target = rows_on_map(landmarks, (run_of << 32) + target_id)
    target[sensor < 0] = -1
    return Sightings(offsets, time_ns, sensor, value, target_id, target, is_last)


def rows_on_map(landmarks: Landmarks, keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows of the map that keys (run * 2^32 + landmark) have, -1 where it lacks them."""
    if len(landmarks.keys) == 0:
        return np.full(len(keys), -1)
    rows = np.minimum(np.searchsorted(landmarks.keys, keys), len(landmarks.keys) - 1)
    return np.where(landmarks.keys[rows] == keys, rows, -1)


def _no_poses(offsets: NDArray[np.int64]) -> Poses:
    rows = offsets[-1]
    return Poses(
        offsets,
        offsets[:-1].copy(),
        event=np.empty(rows, np.int64),
        mean=np.empty((rows, 3)),
        covariance=np.empty((rows, 3, 3)),
    )


def _no_looks(offsets: NDArray[np.int64]) -> Looks:
    rows = offsets[-1]
    return Looks(
        offsets,
        offsets[:-1].copy(),
        event=np.empty(rows, np.int64),
        difference=np.empty((rows, 2)),
        covariance=np.empty((rows, 2, 2)),
        squared=np.empty(rows),
        accepted=np.empty(rows, np.int64),
    )


class Outputs(NamedTuple):
    """The output topics of one bound filter: the parts of their names, and how results fill them."""

    name: str
    truth: str

    def poses(self, poses: Poses, events: Sightings) -> Ragged:
        """The estimates at every distinct stamp."""
        rows, offsets = filled_rows(poses.offsets, poses.end)
        mean = poses.mean[rows]
        mean[:, 2] = wrap_angle(mean[:, 2])
        return self._ragged(
            "pose",
            schemas.GAUSSIAN_ESTIMATE,
            offsets,
            events.time_ns[poses.event[rows]],
            {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"},
            mean=mean,
            covariance=poses.covariance[rows].reshape(-1, 9),
        )

    def innovations(self, looks: Looks, events: Sightings) -> Ragged:
        """How every sighting of the map fitted."""
        rows, offsets = filled_rows(looks.offsets, looks.end)
        event = looks.event[rows]
        return self._ragged(
            "innovation",
            schemas.INNOVATION,
            offsets,
            events.time_ns[event],
            {"components": "range_m,bearing_rad", "kinds": "linear,angle"},
            target_id=events.target_id[event],
            accepted=looks.accepted[rows],
            innovation=looks.difference[rows],
            covariance=looks.covariance[rows].reshape(-1, 4),
            normalised_innovation_squared=looks.squared[rows],
        )

    def _ragged(
        self,
        leaf: str,
        schema: Schema,
        offsets: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        metadata: Mapping[str, str],
        **columns: NDArray[Any],
    ) -> Ragged:
        topic = f"/estimates/{self.name}/{leaf}"
        metadata = {**metadata, "truth": self.truth}
        return Ragged(make_stream(topic, schema, time_ns, metadata=metadata, **columns), offsets)


def stated(topic: Topic, given: Mapping[str, float | None], name: str) -> float:
    """A parameter as given, else as the channel's metadata states it; raises BadInput without either."""
    own = given.get(name)
    try:
        value = float(topic.metadata[name]) if own is None else own
    except (KeyError, ValueError):
        raise BadInput(
            f"topic {topic.name} does not state {name}; give it with --set {name}=..."
        ) from None
    if not 0 <= value < np.inf:
        raise BadInput(f"topic {topic.name} states {name} = {value}; it is zero or positive")
    return value


def _bind(
    name: str,
    topics: Mapping[str, Topic],
    parameters: DeadReckoningParameters,
    *,
    kind: str,
    sampler_at: Callable[[int], Sampler],
    seed: int = 0,
) -> list[Bound]:
    """One filter for every robot that has odometry, a prior and, unless it only reckons, a sensor."""

    def has(topic: str, schema: Schema) -> bool:
        return topic in topics and topics[topic].schema_name == schema.full_name

    bound: list[Bound] = []
    for topic in topics:
        robot, _, leaf = topic.rpartition("/")
        whole, sensed = [f"{robot}/prior"], []
        if leaf != "odometry" or not (
            has(topic, schemas.ODOMETRY) and has(whole[0], schemas.GAUSSIAN_ESTIMATE)
        ):
            continue
        if isinstance(parameters, LocalizationParameters):
            sensed = [
                f"{robot}/{leaf}" for leaf, schema in SENSORS.items() if has(f"{robot}/{leaf}", schema)
            ]
            whole.append("/landmarks")
            if not sensed or not has("/landmarks", schemas.LANDMARK):
                continue
        settings = _settings(topics[topic], [topics[each] for each in sensed], parameters)
        outputs = Outputs(f"{name}{robot}", f"{robot}/truth")
        bound.append(
            Recursive(
                outputs.name,
                (topic, *sensed),
                tuple(whole),
                partial(start, prior_topic=whole[0]),
                partial(
                    run,
                    kind=kind,
                    sampler=sampler_at(3),
                    seed=seed,
                    settings=settings,
                    outputs=outputs,
                ),
                {whole[0]: POSE},
            )
        )
    return bound


def _settings(odometry: Topic, sensors: list[Topic], parameters: DeadReckoningParameters) -> Settings:
    """What the parameters say and, where they do not, the channels' metadata."""
    given = parameters.model_dump()
    density = [stated(odometry, given, f"{way}_noise_density") for way in ("forward", "turn")]
    variance = np.full((len(sensors), 2), np.nan)
    for row, topic in enumerate(sensors):
        measured = [field.name for field in schemas.SCHEMAS[topic.schema_name]]
        for column, name in enumerate(("range_m", "bearing_rad")):
            if name in measured:
                variance[row, column] = stated(topic, given, f"sigma_{name}") ** 2
    bias, gate = np.zeros(2), np.full(3, np.inf)
    if isinstance(parameters, LocalizationParameters):
        bias[:] = parameters.bias_range_m, parameters.bias_bearing_rad
        gate[1:] = chi2.ppf(parameters.gate_probability, [1, 2])
    return Settings(np.array(density), bias, variance, gate)


def _bind_linearised(
    name: str, topics: Mapping[str, Topic], parameters: DeadReckoningParameters
) -> list[Bound]:
    return _bind(name, topics, parameters, kind="linearised", sampler_at=no_samples)


def _bind_unscented(
    name: str, topics: Mapping[str, Topic], parameters: UnscentedParameters
) -> list[Bound]:
    sampling = Unscented(kappa=parameters.kappa)
    return _bind(name, topics, parameters, kind="sampled", sampler_at=sampling.at)


def bind_robots(
    name: str,
    topics: Mapping[str, Topic],
    parameters: LocalizationParameters,
    sampling: Sampling,
    seed: int,
) -> list[Bound]:
    """Bind the filter with this sampling to every robot of the log; the seed is for randomised ones."""
    return _bind(name, topics, parameters, kind="sampled", sampler_at=sampling.at, seed=seed)


DEAD_RECKONING = Estimator(
    "robot pose from odometry alone",
    "per robot, .../odometry and .../prior",
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
