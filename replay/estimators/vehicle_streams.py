"""Cooperative vehicles from the streams of a log: which method uses what, and what it says.

A method is named `FIXES` or `FIXES-SENSOR`, as in `vehicles:hungarian-topology`: how the fixes are
associated, and what is made of the infrastructure sensor. What came at one time in all runs is a frame;
frame after frame is filtered in all runs at once.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveInt

from recorders.errors import BadInput, choices
from recorders.log import Schema, Topic, make_stream, schemas
from recorders.models.planar import wrap_angle
from recorders.models.states import PLANE_MOTION, state_metadata
from recorders.parameters import Parameters
from replay.blocks import Block, Ragged
from replay.engine import Bound, Estimator, Recursive
from replay.estimators.vehicle_association import (
    MISSED,
    Hypotheses,
    Scanning,
    all_maps,
    best_maps,
    log_likelihoods,
)
from replay.estimators.vehicle_registration import fitted_pose, register
from replay.estimators.vehicles import (
    POSE,
    STATES,
    Floats,
    Integers,
    Joint,
    Motion,
    collapse,
    forget_pose,
    position_rows,
    positions,
    predict,
    sight_of,
    topology_measurement,
    update,
    update_by_scalar,
)
from replay.symmetric_sums import (
    power_sums,
    power_sums_at,
    product_sums,
    product_sums_at,
    update_root,
)

Booleans = NDArray[np.bool_]

FIXES = {
    "known": "every vehicle's fixes are known to be its own",
    "hungarian": "unordered fixes, the most probable map",
    "set": "unordered fixes, exact collapse over all maps",
    "axes": "unordered x and unordered y, exact collapse of each: what separate sums of powers tell",
    "powers": "sums of powers of x and of y, linearised",
    "unscented-powers": "the same, sampled",
    "products": "sums of products of x and of y, linearised",
    "complex": "sums of powers of x + iy, linearised",
}
SENSOR = {
    "": "not used",
    "topology": "the sum of squared distances between all detections",
    "registration": "detections from a pose that is another one in every scan",
    "static": "detections from a pose that stays",
}
POSE_COMPONENTS = ("x_m", "y_m", "heading_rad")
FAILED = "the estimate is no longer finite"


class VehiclesParameters(Parameters):
    """The method, and from which scan on the sensor's pose may be found."""

    method: str = "hungarian"
    registration_scan: PositiveInt = 13


class Setup(NamedTuple):
    """A bound method: what it is told."""

    name: str
    fixes: str
    sensor: str
    registration_scan: int
    motion: Motion
    network: Scanning
    infrastructure: Scanning

    @property
    def has_pose(self) -> bool:
        """Whether the state holds the sensor's pose."""
        return self.sensor in ("registration", "static")

    @property
    def states(self) -> int:
        """How many components the joint state has."""
        return STATES * self.motion.vehicles + POSE * self.has_pose


class Carried(NamedTuple):
    """What is carried from block to block; first axis = run.

    `scans` counts the infrastructure sensor's; `registered` says that its pose was found.
    """

    mean: Floats
    covariance: Floats
    time_ns: Integers
    scans: Integers
    registered: Booleans
    failed: Booleans


class Frames(NamedTuple):
    """All that came, by run and frame: times (runs, frames), counts of frames (runs,), measurements.

    `fixes` (runs, frames, vehicles, 2) with `noise` (runs, frames, vehicles, 2, 2), and scans of the
    network and the infrastructure sensor (runs, frames, detections, 2), are NaN where there are none;
    `has_network`, `has_sensor` (runs, frames) say where there is a scan.
    """

    counts: Integers
    time_ns: Integers
    fixes: Floats
    noise: Floats
    network: Floats
    has_network: Booleans
    sensor: Floats
    has_sensor: Booleans


class Results(NamedTuple):
    """Means (runs, frames, n) and covariances after every frame, the maps (runs, frames, vehicles)."""

    mean: Floats
    covariance: Floats
    detection: Integers


def _bind(name: str, topics: Mapping[str, Topic], parameters: VehiclesParameters) -> list[Bound]:
    fixes, sensor = split_method(parameters.method)
    if fixes not in FIXES:
        raise BadInput(f"estimator {name}: no method '{fixes}'; {choices(fixes, FIXES)}")
    bound = bind_vehicles(name, topics, fixes, sensor, parameters.registration_scan)
    if bound is None:
        return []
    setup, used, priors = bound
    return [Recursive(name, used, priors, partial(start, setup), partial(run, setup))]


def bind_vehicles(
    name: str, topics: Mapping[str, Topic], fixes: str, sensor: str, registration_scan: int
) -> tuple[Setup, tuple[str, ...], tuple[str, ...]] | None:
    """What a method is told by a log, the topics it follows, and the priors; None where one is missing."""
    numbers = vehicle_numbers(topics)
    used = ["/network/scan", "/network/detection"]
    if fixes == "known":
        used = [f"/vehicle{number}/fix" for number in numbers]
    if sensor:
        used += ["/infrastructure/scan", "/infrastructure/detection"]
    if not numbers or not set(used) <= set(topics):
        return None
    setup = Setup(
        name,
        fixes,
        sensor,
        registration_scan,
        motion_of(topics, numbers),
        scanning_of(topics, "/network/scan"),
        scanning_of(topics, "/infrastructure/scan"),
    )
    return setup, tuple(used), tuple(f"/vehicle{number}/prior" for number in numbers)


def split_method(method: str) -> tuple[str, str]:
    """What is done with the fixes, and with the infrastructure sensor: empty where that is not used."""
    fixes, _, sensor = method.rpartition("-")
    return (fixes, sensor) if fixes and sensor in SENSOR else (method, "")


def vehicle_numbers(topics: Mapping[str, Topic]) -> list[int]:
    """The numbers of the vehicles of a log."""
    names = [name.removeprefix("/vehicle").partition("/") for name in topics]
    return sorted(int(number) for number, _, leaf in names if leaf == "prior" and number.isdigit())


def motion_of(topics: Mapping[str, Topic], numbers: Sequence[int]) -> Motion:
    """How the vehicles move, as their priors' channels state it."""
    stated = [topics[f"/vehicle{number}/prior"] for number in numbers]
    return Motion(
        np.array([_stated(topic, "turn_rate_radps") for topic in stated]),
        np.array([_stated(topic, "acceleration_sigma_mps2") for topic in stated]),
    )


def scanning_of(topics: Mapping[str, Topic], topic: str) -> Scanning:
    """What a scan's channel states of its sensor; a log without it has no such sensor."""
    if topic not in topics:
        return Scanning(1.0, 1.0, 0.0)
    names = ("variance_m2", "detection_probability", "clutter_per_m2")
    return Scanning(*(_stated(topics[topic], name) for name in names))


def _stated(topic: Topic, name: str) -> float:
    try:
        return float(topic.metadata[name])
    except (KeyError, ValueError):
        raise BadInput(f"topic {topic.name} does not state {name}; record the vehicles again") from None


def start(setup: Setup, whole: Mapping[str, Ragged]) -> Carried:
    """Every run's priors; raises BadInput where a run lacks one, or one is no vehicle's state."""
    runs = next(iter(whole.values())).runs
    mean, covariance = np.zeros((runs, setup.states)), np.zeros((runs, setup.states, setup.states))
    for vehicle, (topic, prior) in enumerate(whole.items()):
        if np.any(np.diff(prior.offsets) == 0):
            raise BadInput(f"topic {topic}: a run has no prior message; the filter cannot start")
        if prior["mean"].shape[1] != STATES or prior["covariance"].shape[1] != STATES**2:
            raise BadInput(f"topic {topic}: a prior of ({', '.join(PLANE_MOTION)}) is needed")
        own = slice(STATES * vehicle, STATES * (vehicle + 1))
        first = prior.offsets[:-1]
        mean[:, own] = prior["mean"][first]
        covariance[:, own, own] = prior["covariance"][first].reshape(-1, STATES, STATES)
        if np.any(np.linalg.eigvalsh(covariance[:, own, own])[:, 0] <= 0):
            raise BadInput(f"topic {topic}: the prior's covariance is not positive definite")
    time_ns = prior.stream.publish_time_ns[first]
    no = np.zeros(runs, bool)
    return Carried(mean, covariance, time_ns, np.zeros(runs, np.int64), no, no)


def run(setup: Setup, carried: Carried, block: Block) -> tuple[Carried, list[Ragged]]:
    """Filter a block; see `replay.engine.Recursive`."""
    frames = frames_of(setup, block)
    runs, count = frames.time_ns.shape
    before = carried.failed
    carried = copy.deepcopy(carried)
    results = Results(
        np.full((runs, count, setup.states), np.nan),
        np.full((runs, count, setup.states, setup.states), np.nan),
        np.full((runs, count, setup.motion.vehicles), MISSED),
    )
    for number in range(count):
        rows = np.flatnonzero((number < frames.counts) & ~carried.failed)
        if len(rows):
            with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges fails, no more
                _advance(setup, carried, frames, number, rows, results)
    return carried, list(outputs_of(setup, frames, results, carried.failed & ~before))


def frames_of(setup: Setup, block: Block) -> Frames:
    """A block's messages by run and frame."""
    events = block.events
    runs = len(events.offsets) - 1
    run_of = np.repeat(np.arange(runs), np.diff(events.offsets))
    ends = np.concatenate([[0], np.cumsum(events.is_last)])
    frame_of = ends[:-1] - ends[events.offsets[:-1]][run_of]
    counts = np.diff(ends[events.offsets])
    shape = (runs, int(counts.max(initial=0)))
    time_ns = np.zeros(shape, np.int64)
    time_ns[run_of, frame_of] = events.time_ns
    names = {name: index for index, name in enumerate(block.streams)}
    vehicles = setup.motion.vehicles
    fixes, noise = np.full((*shape, vehicles, 2), np.nan), np.full((*shape, vehicles, 4), np.nan)

    def place(topic: str) -> tuple[Integers, Integers, Integers]:
        """Runs, frames and rows of a topic's messages."""
        chosen = np.flatnonzero(events.topic == names.get(topic, -1))
        first = sum(len(ragged) for ragged in list(block.streams.values())[: names.get(topic, 0)])
        return run_of[chosen], frame_of[chosen], events.source[chosen] - first

    for topic, ragged in block.streams.items():
        if topic.endswith("/fix") and len(ragged):
            vehicle = names[topic]
            at_run, at_frame, row = place(topic)
            fixes[at_run, at_frame, vehicle] = ragged["position_m"][row]
            noise[at_run, at_frame, vehicle] = ragged["covariance_m2"][row]

    def scans(prefix: str) -> tuple[Floats, Booleans]:
        there = np.zeros(shape, bool)
        at_run, at_frame, _ = place(f"{prefix}/scan")
        there[at_run, at_frame] = True
        at_run, at_frame, row = place(f"{prefix}/detection")
        key = at_run * shape[1] + at_frame
        rank = np.arange(len(key)) - np.searchsorted(key, key)
        padded = np.full((*shape, int(rank.max(initial=-1)) + 1, 2), np.nan)
        if len(row):
            padded[at_run, at_frame, rank] = block.streams[f"{prefix}/detection"]["position_m"][row]
        return padded, there

    matrices = noise.reshape(*shape, vehicles, 2, 2)
    return Frames(counts, time_ns, fixes, matrices, *scans("/network"), *scans("/infrastructure"))


def _advance(
    setup: Setup, carried: Carried, frames: Frames, number: int, rows: Integers, results: Results
) -> None:
    """Take some runs through one frame: changes their rows of what is carried, and fills the results."""
    joint = Joint(carried.mean[rows], carried.covariance[rows])
    time_ns = frames.time_ns[rows, number]
    duration_ns = time_ns - carried.time_ns[rows]
    for span_ns in np.unique(duration_ns):
        joint = _where(
            duration_ns == span_ns, joint, lambda own: predict(setup.motion, own, span_ns * 1e-9)
        )
    if setup.fixes == "known":
        joint = _update_by_fixes(setup, joint, frames.fixes[rows, number], frames.noise[rows, number])
    elif setup.fixes not in ("hungarian", "set", "axes"):
        scanned = np.flatnonzero(frames.has_network[rows, number])
        seen = frames.network[rows[scanned], number]
        joint = _put(joint, scanned, _update_by_sums(setup, joint.of(scanned), seen))
    else:
        scanned = np.flatnonzero(frames.has_network[rows, number])
        own, detection = _update_by_set(setup, joint.of(scanned), frames.network[rows[scanned], number])
        joint = _put(joint, scanned, own)
        results.detection[rows[scanned], number] = detection
    scanned = np.flatnonzero(frames.has_sensor[rows, number])
    if setup.sensor and len(scanned):
        carried.scans[rows[scanned]] += 1
        seen = frames.sensor[rows[scanned], number]
        if setup.sensor == "topology":
            own = _update_by_shape(setup, joint.of(scanned), seen)
        else:
            ready = carried.scans[rows[scanned]] >= setup.registration_scan
            own, found = _update_by_pose(
                setup, joint.of(scanned), seen, carried.registered[rows[scanned]], ready
            )
            carried.registered[rows[scanned]] = found
        joint = _put(joint, scanned, own)
    carried.mean[rows], carried.covariance[rows], carried.time_ns[rows] = *joint, time_ns
    carried.failed[rows] = ~np.isfinite(joint.mean.sum(axis=1) + joint.covariance.sum(axis=(1, 2)))
    well = ~carried.failed[rows]
    results.mean[rows[well], number] = joint.mean[well]
    results.covariance[rows[well], number] = joint.covariance[well]


def _put(joint: Joint, rows: Integers, changed: Joint) -> Joint:
    """The joint states with those of some rows changed."""
    if len(rows) == len(joint.mean):
        return changed
    mean, covariance = joint.mean.copy(), joint.covariance.copy()
    mean[rows], covariance[rows] = changed
    return Joint(mean, covariance)


def _where(chosen: Booleans, joint: Joint, change: Callable[[Joint], Joint]) -> Joint:
    """The joint states, changed where chosen."""
    rows = np.flatnonzero(chosen)
    return _put(joint, rows, change(joint.of(rows))) if len(rows) else joint


def _update_by_fixes(setup: Setup, joint: Joint, fixes: Floats, noise: Floats) -> Joint:
    """Fixes (runs, vehicles, 2) of known vehicles; NaN where one is missing."""
    vehicles = setup.motion.vehicles
    innovation = (fixes - positions(setup.motion, joint.mean)).reshape(-1, 2 * vehicles)
    spread = np.zeros((len(fixes), vehicles, 2, vehicles, 2))
    spread[:, np.arange(vehicles), :, np.arange(vehicles), :] = np.moveaxis(noise, 0, 1)
    matrices = spread.reshape(-1, 2 * vehicles, 2 * vehicles)
    return update(joint, position_rows(vehicles, setup.states), innovation, matrices)


def _update_by_set(setup: Setup, joint: Joint, detections: Floats) -> tuple[Joint, Integers]:
    """Unordered fixes (runs, detections, 2), and the best map of them where there is one for both axes."""
    vehicles = setup.motion.vehicles
    for axes in ((0,), (1,)) if setup.fixes == "axes" else ((0, 1),):
        rows = position_rows(vehicles, setup.states, axes)
        predicted = (joint.mean @ rows.T).reshape(-1, vehicles, len(axes))
        noise = setup.network.variance_m2 * np.ones(vehicles * len(axes))
        spread = rows @ joint.covariance @ rows.T + np.diag(noise)
        places = detections[..., axes]
        likelihood = log_likelihoods(predicted, blocks_of(spread, vehicles), places)
        maps = (best_maps if setup.fixes == "hungarian" else all_maps)(likelihood, setup.network)
        joint = collapse(joint, rows, innovations_of(maps, predicted, places), noise, maps)
    detection = np.full((len(joint.mean), vehicles), MISSED)
    if setup.fixes == "hungarian":
        detection = maps.detection
    return joint, detection


def _update_by_sums(setup: Setup, joint: Joint, detections: Floats) -> Joint:
    """Symmetric sums of full scans (runs, detections, 2); others have no such sums and tell nothing.

    Sums of numbers less their expected mean are linear combinations of the sums themselves, with other
    numbers of digits lost.
    """
    vehicles, states = setup.motion.vehicles, setup.states
    full = np.flatnonzero(np.isfinite(detections[..., 0]).sum(axis=1) == vehicles)
    own, places = joint.of(full), detections[full, :vehicles]
    sigma = float(np.sqrt(setup.network.variance_m2))
    if setup.fixes == "complex":
        combinations = [
            position_rows(vehicles, states, (0,)) + 1j * position_rows(vehicles, states, (1,))
        ]
        numbers = [places @ np.array([1.0, 1j])]
    else:
        combinations = [position_rows(vehicles, states, (axis,)) for axis in (0, 1)]
        numbers = [places[..., axis] for axis in (0, 1)]
    measure, expect = (
        (lambda m: product_sums(m), product_sums_at)
        if setup.fixes == "products"
        else (lambda m: power_sums(m, sigma), power_sums_at)
    )
    for rows, m in zip(combinations, numbers, strict=True):
        root = _root(own.covariance)
        p = own.mean @ rows.T
        middle = p.mean(axis=1, keepdims=True)
        pseudo = expect(p - middle, sigma)
        expected, measured = pseudo.expected, pseudo.jacobian @ (rows @ root)
        if setup.fixes == "unscented-powers":
            root = np.concatenate([root, -root], axis=2) * np.sqrt(0.5)
            steps = np.sqrt(2.0 * states) * np.swapaxes(rows @ root, 1, 2)
            samples = expect((p - middle)[:, None] + steps, sigma).expected
            expected = samples.mean(axis=1)
            measured = np.swapaxes(samples - expected[:, None], 1, 2) / np.sqrt(2.0 * states)
        innovation = measure(m - middle) - expected
        mean, root = update_root(own.mean, root, measured, innovation, pseudo.factor)
        own = Joint(mean, root @ np.swapaxes(root, 1, 2))
    return _put(joint, full, own)


def _root(covariance: Floats) -> Floats:
    """Factors X with X X' = covariances that rounding may have made a little indefinite."""
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        values, axes = np.linalg.eigh(np.nan_to_num(covariance))
        return np.asarray(axes * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def blocks_of(matrices: Floats, vehicles: int) -> Floats:
    """The blocks (runs, vehicles, a, a) on the diagonals of matrices (runs, vehicles a, vehicles a)."""
    size = matrices.shape[-1] // vehicles
    split = matrices.reshape(-1, vehicles, size, vehicles, size)
    index = np.arange(vehicles)
    return np.moveaxis(split[:, index, :, index, :], 0, 1)


def innovations_of(maps: Hypotheses, predicted: Floats, places: Floats) -> Floats:
    """Detections less predictions, (h, vehicles * axes), in the vehicles' order; NaN where missed."""
    if places.shape[1] == 0:
        return np.full((len(maps.run), predicted[0].size), np.nan)
    chosen = places[maps.run[:, None], maps.detection]
    innovation = np.where((maps.detection == MISSED)[..., None], np.nan, chosen - predicted[maps.run])
    return innovation.reshape(len(maps.run), -1)


def _update_by_shape(setup: Setup, joint: Joint, seen: Floats) -> Joint:
    """Topology; scans with another number of detections than vehicles tell nothing."""
    vehicles = setup.motion.vehicles
    is_full = np.isfinite(seen[..., 0]).sum(axis=1) == vehicles
    rows = np.flatnonzero(is_full)
    if len(rows) == 0:
        return joint
    own = joint.of(rows)
    variance_m2 = setup.infrastructure.variance_m2
    measured = topology_measurement(setup.motion, own, seen[rows, :vehicles], variance_m2)
    return _put(joint, rows, update_by_scalar(own, measured))


def _update_by_pose(
    setup: Setup, joint: Joint, seen: Floats, registered: Booleans, ready: Booleans
) -> tuple[Joint, Booleans]:
    """Detections (runs, detections, 2) seen from a pose that is found along; which runs have found it."""
    vehicles = setup.motion.vehicles
    ordered = np.full((len(seen), vehicles, 2), np.nan)
    places = positions(setup.motion, joint.mean)
    fresh = ~registered
    known = np.flatnonzero(registered)
    if len(known):
        ordered[known] = _recognised(setup, joint.of(known), seen[known])
    is_full = np.isfinite(seen[..., 0]).sum(axis=1) == vehicles
    unknown = np.flatnonzero(~registered & ready & is_full)
    if len(unknown):
        spread = _position_blocks(setup, joint.of(unknown))
        noise = setup.infrastructure.variance_m2 + 0.5 * np.trace(spread, axis1=2, axis2=3).mean()
        found = register(places[unknown], seen[unknown, :vehicles], float(noise))
        clear = unknown[found.is_clear]
        order = found.detection[found.is_clear]
        ordered[clear] = np.take_along_axis(seen[clear], order[..., None], 1)
        registered = registered.copy()
        registered[clear] = True
    enough = registered & (np.isfinite(ordered[..., 0]).sum(axis=1) >= 2)
    forgotten = enough & (fresh | (setup.sensor == "registration"))
    joint = _where(
        forgotten,
        joint,
        lambda own: forget_pose(own, fitted_pose(places[forgotten], ordered[forgotten])),
    )
    rows = np.flatnonzero(enough if setup.sensor == "registration" else registered)
    if len(rows) == 0:
        return joint, registered
    sight = sight_of(setup.motion, joint.of(rows))
    noise_matrix = setup.infrastructure.variance_m2 * np.eye(2 * vehicles)
    innovation = ordered[rows].reshape(len(rows), -1) - sight.predicted
    return _put(joint, rows, update(joint.of(rows), sight.rows, innovation, noise_matrix)), registered


def _position_blocks(setup: Setup, joint: Joint) -> Floats:
    rows = position_rows(setup.motion.vehicles, setup.states)
    return blocks_of(rows @ joint.covariance @ rows.T, setup.motion.vehicles)


def _recognised(setup: Setup, joint: Joint, seen: Floats) -> Floats:
    """The detections (runs, vehicles, 2) in the vehicles' order, by the pose as it is thought to be."""
    vehicles = setup.motion.vehicles
    sight = sight_of(setup.motion, joint)
    spread = sight.rows @ joint.covariance @ sight.rows.swapaxes(1, 2)
    spread += setup.infrastructure.variance_m2 * np.eye(2 * vehicles)
    predicted = sight.predicted.reshape(-1, vehicles, 2)
    maps = best_maps(log_likelihoods(predicted, blocks_of(spread, vehicles), seen), setup.infrastructure)
    if seen.shape[1] == 0:
        return np.full((len(seen), vehicles, 2), np.nan)
    chosen = np.take_along_axis(seen, np.maximum(maps.detection, 0)[..., None], 1)
    return np.where((maps.detection == MISSED)[..., None], np.nan, chosen)


def outputs_of(setup: Setup, frames: Frames, results: Results, failing: Booleans) -> Iterator[Ragged]:
    """Every vehicle's estimates, the pose's where it is estimated, and who failed."""
    runs, count = frames.time_ns.shape
    said = np.isfinite(results.mean).all(axis=2) & (np.arange(count) < frames.counts[:, None])
    offsets = np.concatenate([[0], np.cumsum(said.sum(axis=1))])
    time_ns, mean, covariance = frames.time_ns[said], results.mean[said], results.covariance[said]

    def gaussians(case: str, names: Sequence[str], own: slice) -> Ragged:
        values = mean[:, own].copy()
        angular = [index for index, name in enumerate(names) if name.endswith("_rad")]
        values[:, angular] = wrap_angle(values[:, angular])
        stream = make_stream(
            f"/estimates/{setup.name}/{case}/state",
            schemas.GAUSSIAN_ESTIMATE,
            time_ns,
            metadata=state_metadata(names) | {"truth": f"/{case}/truth"},
            mean=values,
            covariance=covariance[:, own, own].reshape(len(values), -1),
        )
        return Ragged(stream, offsets)

    vehicles = setup.motion.vehicles
    for vehicle in range(vehicles):
        own = slice(STATES * vehicle, STATES * (vehicle + 1))
        yield gaussians(f"vehicle{vehicle + 1}", PLANE_MOTION, own)
    if setup.has_pose:
        yield gaussians("infrastructure", POSE_COMPONENTS, slice(STATES * vehicles, None))
    failed = np.flatnonzero(failing)
    last = np.maximum(said.sum(axis=1), 1) - 1
    stream = make_stream(
        f"/estimates/{setup.name}/failure",
        schemas.FAILURE,
        frames.time_ns[failed, last[failed]],
        metadata={"reasons": FAILED},
        reason=np.zeros(len(failed), np.int64),
    )
    yield Ragged(stream, np.searchsorted(failed, np.arange(runs + 1)))


VEHICLES = Estimator(
    "cooperative vehicles; the method follows the name, as in vehicles:hungarian-topology",
    "/vehicleN/prior and, by method, /vehicleN/fix, /network and /infrastructure",
    VehiclesParameters,
    _bind,
    variant="method",
)
