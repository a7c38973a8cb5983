"""Filters of cooperative vehicles for replay: methods, their topics and their outputs.

The name of a method is `FIXES` or `FIXES-SENSOR`, as in `vehicles:hungarian-topology`: how fixes are
used, and how the infrastructure sensor is used. A frame contains all messages of a run with the same
stamp. The filter processes frame after frame, for all runs in parallel.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.engine.streams.blocks import Block, Ragged, run_of_rows
from fuselog.replay.engine.streams.channels import numbered, stated
from fuselog.replay.engine.streams.failures import Failure, reason_stream
from fuselog.replay.engine.streams.measurements import PLANE, read_fixes, read_vectors
from fuselog.replay.engine.streams.results import (
    InnovationColumns,
    failures_by_run,
    innovation_stream,
    state_stream,
)
from fuselog.replay.engine.vectors.components import Components, components_of
from fuselog.replay.families.vehicles.association import MISSED, Scanning
from fuselog.replay.families.vehicles.updates import (
    FIXES,
    SENSOR,
    Associated,
    Setup,
    put,
    split_method,
    update_by_fixes,
    update_by_pose,
    update_by_set,
    update_by_sums,
    update_by_topology,
    where,
)
from fuselog.replay.families.vehicles.vehicles import POSE, STATES, Joint, Motion, predict

POSE_COMPONENTS = ("x_m", "y_m", "heading_rad")
FAILED = "the estimate is no longer finite"


class VehiclesParameters(Parameters):
    """Method and assumptions of the filter.

    Attributes:
        method: `FIXES` or `FIXES-SENSOR`, as in hungarian-topology: how fixes are used (known,
            hungarian, set, axes, powers, unscented-powers, products or complex), and how the roadside
            sensor is used (topology, registration or static).
        registration_scan: number of the first scan from which the sensor's pose may be estimated.
        sigma_fix_m: standard deviation of each component of a fix without a stated covariance; if it is
            not set, fixes without a covariance are not used.
    """

    method: str = "hungarian"
    registration_scan: PositiveInt = 13
    sigma_fix_m: PositiveFloat | None = None


class VehiclesState(NamedTuple):
    """Joint state between blocks; the first axis is the run.

    `scans` counts the scans of the infrastructure sensor; `registered` marks runs in which its pose was
    found.
    """

    mean: Floats
    covariance: Floats
    time_ns: Integers
    scans: Integers
    registered: Booleans
    failed: Booleans


class Frames(NamedTuple):
    """Measurements by run and frame: times (runs, frames), counts (runs,), and values.

    `fixes` (runs, frames, vehicles, 2) with `noise` (runs, frames, vehicles, 2, 2), and scans of the
    network and the infrastructure sensor (runs, frames, detections, 2), are NaN if missing.
    `has_network` and `has_sensor` (runs, frames) mark frames with a scan; `skipped` (runs, frames,
    vehicles) marks fixes that are not used because their covariance is missing.
    """

    counts: Integers
    time_ns: Integers
    fixes: Floats
    noise: Floats
    network: Floats
    has_network: Booleans
    sensor: Floats
    has_sensor: Booleans
    skipped: Booleans


class VehiclesResults(NamedTuple):
    """Means (runs, frames, n) and covariances after every frame, and maps if the method uses one map.

    `associated` has arrays (runs, frames, vehicles, ...); innovations are NaN if nothing was associated.
    """

    mean: Floats
    covariance: Floats
    associated: Associated


def no_results(setup: Setup, runs: int, frames: int) -> VehiclesResults:
    """Make results that are NaN everywhere."""
    states, vehicles = setup.states, setup.motion.vehicles
    return VehiclesResults(
        np.full((runs, frames, states), np.nan),
        np.full((runs, frames, states, states), np.nan),
        Associated(
            np.full((runs, frames, vehicles), MISSED),
            np.full((runs, frames, vehicles, 2), np.nan),
            np.full((runs, frames, vehicles, 2, 2), np.nan),
        ),
    )


def _find(name: str, topics: Mapping[str, Topic], parameters: VehiclesParameters) -> Iterator[Binding]:
    fixes, sensor = split_method(parameters.method)
    if fixes not in FIXES:
        sensors = " or ".join(f"-{each}" for each in SENSOR if each)
        known = f"{choices(fixes, FIXES)}, optionally followed by {sensors}"
        raise BadInput(f"estimator {name}: no method '{fixes}'; {known}")
    found = find_vehicles(name, topics, fixes, sensor)
    scan, sigma_m = parameters.registration_scan, parameters.sigma_fix_m
    for each in found:
        setup = each.setup._replace(registration_scan=scan, sigma_fix_m=sigma_m)
        yield each._replace(setup=setup)


def find_vehicles(name: str, topics: Mapping[str, Topic], fixes: str, sensor: str) -> Iterator[Binding]:
    """Find the topics that a method uses; yield nothing if one is missing."""
    numbers = vehicle_numbers(topics)
    used = ["/network/scan", "/network/detection"]
    if fixes == "known":
        used = [f"/vehicle{number}/fix" for number in numbers]
    if sensor:
        used += ["/infrastructure/scan", "/infrastructure/detection"]
    if not numbers or not set(used) <= set(topics):
        return
    setup = Setup(
        name,
        tuple(numbers),
        fixes,
        sensor,
        motion_of(topics, numbers),
        scanning_of(topics, "/network/scan"),
        scanning_of(topics, "/infrastructure/scan"),
    )
    state: Components = dict.fromkeys(PLANE_MOTION, "linear")
    priors = [f"/vehicle{number}/prior" for number in numbers]
    followed, fixed = ({each: topics[each] for each in names} for names in (used, priors))
    yield Binding(followed, fixed, priors=dict.fromkeys(priors, state), setup=setup)


def vehicle_numbers(topics: Mapping[str, Topic]) -> list[int]:
    """Return the numbers of the vehicles in a log."""
    return list(numbered(topics, "vehicle", "prior", schemas.GAUSSIAN_ESTIMATE))


def motion_of(topics: Mapping[str, Topic], numbers: Sequence[int]) -> Motion:
    """Read the motion parameters of the vehicles from the channels of their priors."""
    priors = [topics[f"/vehicle{number}/prior"] for number in numbers]
    return Motion(*(np.array([stated([prior], name) for prior in priors]) for name in Motion._fields))


def scanning_of(topics: Mapping[str, Topic], topic: str) -> Scanning:
    """Read the properties of a sensor from its scan channel; use defaults if the topic is missing."""
    if topic not in topics:
        return Scanning(1.0, 1.0, 0.0)
    return Scanning(*(stated([topics[topic]], name) for name in Scanning._fields))


def _start(given: Given[Any]) -> tuple[Setup, VehiclesState]:
    return given.setup, start(given.setup, given)


def start(setup: Setup, given: Given[Any]) -> VehiclesState:
    """Make the initial state from the priors of every run."""
    runs = given.runs
    mean, covariance = np.zeros((runs, setup.states)), np.zeros((runs, setup.states, setup.states))
    for vehicle, prior in enumerate(given):
        own = slice(STATES * vehicle, STATES * (vehicle + 1))
        time_ns, mean[:, own], covariance[:, own, own] = given.prior(prior)
    registered, failed = np.zeros((2, runs), bool)
    return VehiclesState(mean, covariance, time_ns, np.zeros(runs, np.int64), registered, failed)


def run(setup: Setup, carried: VehiclesState, block: Block) -> tuple[VehiclesState, list[Ragged]]:
    """Filter a block; see `fuselog.replay.engine.api.functions.recursive`."""
    frames = frames_of(setup, block)
    runs, count = frames.time_ns.shape
    before = carried.failed
    carried = copy.deepcopy(carried)
    results = no_results(setup, runs, count)
    for number in range(count):
        rows = np.flatnonzero((number < frames.counts) & ~carried.failed)
        if len(rows):
            with np.errstate(over="ignore", invalid="ignore"):  # only the run that diverges fails
                _advance(setup, carried, frames, number, rows, results)
    return carried, list(outputs_of(setup, frames, results, carried.failed & ~before))


def frames_of(setup: Setup, block: Block) -> Frames:
    """Arrange a block's messages by run and frame."""
    events = block.events
    runs = len(events.offsets) - 1
    run_of = run_of_rows(events.offsets)
    ends = np.concatenate([[0], np.cumsum(events.is_last)])
    frame_of = ends[:-1] - ends[events.offsets[:-1]][run_of]
    counts = np.diff(ends[events.offsets])
    shape = (runs, int(counts.max(initial=0)))
    time_ns = np.zeros(shape, np.int64)
    time_ns[run_of, frame_of] = events.time_ns
    names = {name: index for index, name in enumerate(block.streams)}
    vehicles = setup.motion.vehicles
    fixes, noise = np.full((*shape, vehicles, 2), np.nan), np.full((*shape, vehicles, 2, 2), np.nan)
    skipped = np.zeros((*shape, vehicles), bool)

    def place(topic: str) -> tuple[Integers, Integers, Integers]:
        """Return runs, frames and rows of the messages of a topic."""
        chosen = np.flatnonzero(events.topic == names.get(topic, -1))
        first = sum(len(ragged) for ragged in list(block.streams.values())[: names.get(topic, 0)])
        return run_of[chosen], frame_of[chosen], events.source[chosen] - first

    for topic, ragged in block.streams.items():
        if topic.endswith("/fix") and len(ragged):
            vehicle = names[topic]
            at_run, at_frame, row = place(topic)
            read = read_fixes(ragged.stream, "position_m", "covariance_m2", PLANE, setup.sigma_fix_m)
            skipped[at_run, at_frame, vehicle] = read.missing[row]
            used = ~read.missing[row]
            at_run, at_frame, row = at_run[used], at_frame[used], row[used]
            fixes[at_run, at_frame, vehicle] = read.value[row]
            noise[at_run, at_frame, vehicle] = read.covariance[row]

    def scans(prefix: str) -> tuple[Floats, Booleans]:
        there = np.zeros(shape, bool)
        at_run, at_frame, _ = place(f"{prefix}/scan")
        there[at_run, at_frame] = True
        at_run, at_frame, row = place(f"{prefix}/detection")
        key = at_run * shape[1] + at_frame
        rank = np.arange(len(key)) - np.searchsorted(key, key)
        padded = np.full((*shape, int(rank.max(initial=-1)) + 1, 2), np.nan)
        if len(row):
            seen = block.streams[f"{prefix}/detection"].stream
            padded[at_run, at_frame, rank] = read_vectors(seen, "position_m", PLANE)[row]
        return padded, there

    scanned = (*scans("/network"), *scans("/infrastructure"))
    return Frames(counts, time_ns, fixes, noise, *scanned, skipped)


def _advance(
    setup: Setup,
    carried: VehiclesState,
    frames: Frames,
    number: int,
    rows: Integers,
    results: VehiclesResults,
) -> None:
    """Process one frame of some runs: update their rows of the state, and write the results."""
    time_ns = frames.time_ns[rows, number]
    joint = _predicted(
        setup, Joint(carried.mean[rows], carried.covariance[rows]), time_ns - carried.time_ns[rows]
    )
    scanned = np.flatnonzero(frames.has_network[rows, number])
    if setup.fixes == "known":
        joint = update_by_fixes(setup, joint, frames.fixes[rows, number], frames.noise[rows, number])
    elif len(scanned):
        own, seen = joint.of(scanned), frames.network[rows[scanned], number]
        if setup.uses_sums:
            joint = put(joint, scanned, update_by_sums(setup, own, seen))
        else:
            own, associated = update_by_set(setup, own, seen)
            joint = put(joint, scanned, own)
            for column, found in zip(results.associated, associated or (), strict=False):
                column[rows[scanned], number] = found
    scanned = np.flatnonzero(frames.has_sensor[rows, number])
    if setup.sensor and len(scanned):
        runs = rows[scanned]
        own, seen = joint.of(scanned), frames.sensor[runs, number]
        carried.scans[runs] += 1
        if setup.sensor == "topology":
            own = update_by_topology(setup, own, seen)
        else:
            may_start = carried.scans[runs] >= setup.registration_scan
            own, carried.registered[runs] = update_by_pose(
                setup, own, seen, carried.registered[runs], may_start
            )
        joint = put(joint, scanned, own)
    carried.mean[rows], carried.covariance[rows], carried.time_ns[rows] = *joint, time_ns
    well = np.isfinite(joint.mean.sum(axis=1) + joint.covariance.sum(axis=(1, 2)))
    carried.failed[rows] = ~well
    results.mean[rows[well], number] = joint.mean[well]
    results.covariance[rows[well], number] = joint.covariance[well]


def _predicted(setup: Setup, joint: Joint, duration_ns: Integers) -> Joint:
    """Predict the joint states over durations (runs,); runs with equal durations form one group."""
    for span_ns in np.unique(duration_ns):
        move = partial(predict, setup.motion, duration_s=float(span_ns) * 1e-9)
        joint = where(duration_ns == span_ns, joint, move)
    return joint


def outputs_of(
    setup: Setup, frames: Frames, results: VehiclesResults, failing: Booleans
) -> Iterator[Ragged]:
    """Yield the estimates of every vehicle and of the sensor's pose, if it is estimated; yield failures.

    Args:
        setup: the bound method.
        frames, results: measurements and results of all runs.
        failing: (runs,), which runs failed in these frames.
    """
    runs, count = frames.time_ns.shape
    is_estimated = np.isfinite(results.mean).all(axis=2) & (np.arange(count) < frames.counts[:, None])

    def gaussians(case: str, names: Sequence[str], own: slice, rows: Booleans) -> Ragged:
        stream = state_stream(
            f"/estimates/{setup.name}/{case}/state",
            frames.time_ns[rows],
            components_of(names),
            f"/{case}/truth",
            results.mean[rows][:, own],
            results.covariance[rows][:, own, own],
        )
        return Ragged(stream, np.concatenate([[0], np.cumsum(rows.sum(axis=1))]))

    def innovations(vehicle: int) -> Ragged:
        """Return a vehicle's innovations; their target is the number of the detection in its scan."""
        detection, innovation, spread = (each[:, :, vehicle] for each in results.associated)
        is_associated = detection != MISSED
        squared = np.einsum(
            "ni,nij,nj->n",
            innovation[is_associated],
            np.linalg.inv(spread[is_associated]),
            innovation[is_associated],
        )
        columns = InnovationColumns(
            frames.time_ns[is_associated],
            detection[is_associated] + 1,
            np.ones(is_associated.sum(), np.int64),
            innovation[is_associated],
            spread[is_associated],
            squared,
        )
        topic = f"/estimates/{setup.name}/vehicle{setup.numbers[vehicle]}/innovation"
        stream = innovation_stream(topic, PLANE, "", columns)
        return Ragged(stream, np.concatenate([[0], np.cumsum(is_associated.sum(axis=1))]))

    vehicles = setup.motion.vehicles
    for vehicle in range(vehicles):
        own = slice(STATES * vehicle, STATES * (vehicle + 1))
        yield gaussians(f"vehicle{setup.numbers[vehicle]}", PLANE_MOTION, own, is_estimated)
        if setup.fixes == "hungarian":
            yield innovations(vehicle)
    if setup.has_pose:
        is_found = results.covariance[:, :, -1, -1] > 0.0
        yield gaussians("infrastructure", POSE_COMPONENTS, slice(-POSE, None), is_estimated & is_found)
    last = np.maximum(is_estimated.sum(axis=1), 1) - 1
    failures = {
        run: Failure(int(frames.time_ns[run, last[run]]), FAILED)
        for run in np.flatnonzero(failing).tolist()
    }
    yield failures_by_run(f"/estimates/{setup.name}", failures, runs)
    if setup.fixes == "known":
        at_run, at_frame, which = np.nonzero(frames.skipped)
        remedy = "its fixes have no covariance; give --set sigma_fix_m=..."
        stream = reason_stream(
            f"/estimates/{setup.name}/skipped",
            schemas.SKIPPED,
            frames.time_ns[at_run, at_frame],
            which,
            [f"topic /vehicle{number}/fix: {remedy}" for number in setup.numbers],
        )
        yield Ragged(stream, np.searchsorted(at_run, np.arange(runs + 1)))


VEHICLES = recursive(
    "cooperative vehicles; the method follows the name: vehicles:hungarian-topology",
    parameters=VehiclesParameters,
    find=_find,
    requirements="/vehicleN/prior and, by method, /vehicleN/fix, /network and /infrastructure",
    start=_start,
    advance=run,
    variant="method",
)
