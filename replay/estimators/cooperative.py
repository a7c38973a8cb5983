"""Cooperative localization: robots that share position estimates when they see each other.

Every robot follows its odometry; the anchors use the mapped landmarks as well. When a robot sees
another, each of the two takes the sighting as a measurement of itself that rests on the other one:
as if that were independent (naive), or by covariance intersection (Jin, Lee, Hashimoto, DIND networks,
4.2 and 5.2; the sensor's own noise is independent). The joint filter keeps all correlations, as a centre
could.
"""

import copy
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from scipy.stats import chi2

from recorders.log import Topic, make_stream, schemas
from recorders.models.planar import drive, range_bearing, range_bearing_jacobian, wrap_angle
from recorders.parameters import Parameters
from replay.blocks import Block, Ragged
from replay.compile import compile_over_runs
from replay.engine import Bound, Estimator, Recursive
from replay.estimators.covariance_intersection import inverted, multiply, sight
from replay.estimators.gaussian import Floats, Function, Innovation, correct, wrap
from replay.estimators.landmarks import (
    Landmarks,
    fill_motion_jacobians,
    map_of_runs,
    rows_on_map,
    start,
    stated,
)

Integers = NDArray[np.int64]
Mode = Literal["alone", "naive", "ci", "joint"]
FAILURES = ("a covariance is no longer positive definite", "an estimate is no longer finite")


class CooperativeParameters(Parameters):
    """How sightings of robots are used, and who uses landmarks; None takes what the channels state."""

    mode: Mode = "ci"
    anchors: tuple[int, ...] = (3,)
    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


class Carried(NamedTuple):
    """What goes from block to block; first axis = run. `failure` is -1 while all is well.

    The mean (3 n,) and covariance (3 n, 3 n) are of all n robots; only the joint filter has entries
    between robots.
    """

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: Integers
    failure: Integers


class Settings(NamedTuple):
    """Noise of the robots' odometry and sensors, both (n, 2), who is an anchor, and the gate."""

    density: Floats
    variance: Floats
    anchor: NDArray[np.bool_]
    gate: Floats


class Events(NamedTuple):
    """The events of all runs in order: the robot, and what it says.

    Odometry has `target` -1 and value (forward, turn); a sighting has value (range, bearing) and the
    target's row: of robot t it is t, of the map's row m it is n + m. Others are left out. `emit` is the
    row of the output that an event fills, -1 for none.
    """

    offsets: Integers
    time_ns: Integers
    robot: Integers
    target: Integers
    value: Floats
    emit: Integers


class Results(NamedTuple):
    """Poses (m, 3) and covariances (m, 3, 3), NaN after a failure."""

    mean: Floats
    covariance: Floats


def advance(carried: Carried, run: int, robot: int, time_ns: int, density: Floats) -> None:
    """Move one robot to a time by its odometry, with its correlations."""
    duration_s = (time_ns - carried.time_ns[run, robot]) * 1e-9
    if duration_s <= 0.0:
        return
    carried.time_ns[run, robot] = time_ns
    first = 3 * robot
    pose = carried.mean[run, first : first + 3]
    covariance = carried.covariance[run]
    velocity = carried.velocity[run, robot]
    transition, gain = np.empty((3, 3)), np.empty((3, 2))
    fill_motion_jacobians(pose, velocity, duration_s, transition, gain)
    moved = drive(pose, velocity, duration_s)
    size = len(covariance)
    column = np.empty(3)
    for row in range(3):
        pose[row] = moved[row]
    for other in range(size):
        for row in range(3):
            column[row] = 0.0
            for k in range(3):
                column[row] += transition[row, k] * covariance[first + k, other]
        for row in range(3):
            covariance[first + row, other] = column[row]
    for other in range(size):
        for row in range(3):
            column[row] = 0.0
            for k in range(3):
                column[row] += transition[row, k] * covariance[other, first + k]
        for row in range(3):
            covariance[other, first + row] = column[row]
    for row in range(3):
        for k in range(row + 1):
            for source in range(2):
                noise = gain[row, source] * density[source] ** 2 / duration_s * gain[k, source]
                covariance[first + row, first + k] += noise
                if k < row:
                    covariance[first + k, first + row] += noise


def fill_spread(rows: Floats, covariance: Floats, spread: Floats) -> None:
    """Fill rows covariance rows'."""
    part = np.empty((rows.shape[0], covariance.shape[1]))
    multiply(rows, covariance, part)
    multiply(part, rows.T, spread)


def improve(
    mean: Floats,
    covariance: Floats,
    rows: Floats,
    innovation: Floats,
    noise: Floats,
    gate: Floats,
) -> bool:
    """The extended Kalman filter's update, in place; False where a covariance is not definite."""
    cross, spread = np.empty((len(mean), 2)), np.empty((2, 2))
    multiply(covariance, rows.T, cross)
    multiply(rows, cross, spread)
    for row in range(2):
        for column in range(2):
            spread[row, column] += noise[row, column]
    squared, _ = correct(mean, covariance, Innovation(innovation, spread, cross), gate)
    return not np.isnan(squared)


def is_outlier(
    rows: Floats, covariance: Floats, shared: Floats, own: Floats, innovation: Floats, gate: Floats
) -> bool:
    """Whether the gate is shut for a sighting, whatever its correlation with the state.

    For any correlation the innovation's covariance is at most that of halves, 2 H P H' + 2 shared + own.
    """
    spread, precision = np.empty((2, 2)), np.empty((2, 2))
    fill_spread(rows, covariance, spread)
    for row in range(2):
        for column in range(2):
            spread[row, column] = 2.0 * (spread[row, column] + shared[row, column]) + own[row, column]
    if not inverted(spread, precision):
        return False
    squared = 0.0
    for row in range(2):
        for column in range(2):
            squared += innovation[row] * precision[row, column] * innovation[column]
    return squared > gate[2]


def cooperation(joint: bool, intersect: bool, share: bool) -> Function:
    """The loop over the events of one run."""

    def cooperate(
        run: int, events: Events, places: Floats, settings: Settings, carried: Carried, results: Results
    ) -> None:
        mean, covariance = carried.mean[run], carried.covariance[run]
        robots = len(settings.anchor)
        jacobian = np.empty((2, 3))
        own, other = np.empty((2, 2)), np.empty((2, 2))
        innovation = np.empty(2)
        for event in range(events.offsets[run], events.offsets[run + 1]):
            robot, now = events.robot[event], events.time_ns[event]
            if carried.failure[run] >= 0 or now < carried.time_ns[run, robot]:
                continue
            advance(carried, run, robot, now, settings.density[robot])
            target, first = events.target[event], 3 * robot
            pose = mean[first : first + 3]
            block = covariance[first : first + 3, first : first + 3]
            if target < 0:
                carried.velocity[run, robot] = events.value[event]
            elif target >= robots or share:
                seen = 3 * target
                if target < robots:
                    advance(carried, run, target, now, settings.density[target])
                    place = mean[seen : seen + 2].copy()
                else:
                    place = places[target - robots]
                expected = range_bearing(pose, place)
                by_range, by_bearing = range_bearing_jacobian(pose, place)
                for k in range(3):
                    jacobian[0, k] = by_range[k]
                    jacobian[1, k] = by_bearing[k]
                innovation[0] = events.value[event, 0] - expected[0]
                innovation[1] = wrap(events.value[event, 1] - expected[1], True)
                own[:] = 0.0
                own[0, 0] = settings.variance[robot, 0]
                own[1, 1] = settings.variance[robot, 1]
                good = True
                if joint or target >= robots:
                    rows = np.zeros((2, len(mean)))
                    rows[:, first : first + 3] = jacobian
                    if target < robots:
                        rows[:, seen : seen + 2] = -jacobian[:, :2]
                    good = improve(mean, covariance, rows, innovation, own, settings.gate)
                else:
                    place_rows = np.zeros((2, 3))
                    place_rows[:, :2] = -jacobian[:, :2]
                    there = covariance[seen : seen + 3, seen : seen + 3]
                    here_before, there_before = block.copy(), there.copy()
                    for side in range(2):
                        if side == 0:
                            rows, at, spread = jacobian, pose, block
                            fill_spread(place_rows, there_before, other)
                        else:
                            rows, at, spread = place_rows, mean[seen : seen + 3], there
                            fill_spread(jacobian, here_before, other)
                        if intersect:
                            fused, fused_spread = np.empty(3), np.empty((3, 3))
                            if is_outlier(rows, spread, other, own, innovation, settings.gate):
                                continue
                            weight = sight(
                                at.copy(),
                                spread.copy(),
                                rows,
                                innovation,
                                other,
                                own,
                                fused,
                                fused_spread,
                            )
                            good = good and not np.isnan(weight)
                            at[:] = fused
                            spread[:] = fused_spread
                        else:
                            for row in range(2):
                                for column in range(2):
                                    other[row, column] += own[row, column]
                            good = good and improve(at, spread, rows, innovation, other, settings.gate)
                if not good:
                    carried.failure[run] = 0
                    continue
            if not np.isfinite(mean.sum()):
                carried.failure[run] = 1
            elif events.emit[event] >= 0:
                results.mean[events.emit[event]] = pose
                results.covariance[events.emit[event]] = block

    return cooperate


@lru_cache(maxsize=4)
def _compiled(mode: Mode) -> Function:
    return compile_over_runs(cooperation(mode == "joint", mode == "ci", mode != "alone"))


def begin(whole: Mapping[str, Ragged], prefixes: tuple[str, ...]) -> tuple[Carried, Landmarks]:
    """All robots at their priors, and the maps; raises BadInput as `landmarks.start` does."""
    started = [start(whole, f"{prefix}/prior")[0] for prefix in prefixes]
    runs, size = len(started[0].mean), 3 * len(prefixes)
    covariance = np.zeros((runs, size, size))
    for index, each in enumerate(started):
        covariance[:, 3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = each.covariance
    carried = Carried(
        np.concatenate([each.mean for each in started], axis=1),
        covariance,
        np.zeros((runs, len(prefixes), 2)),
        np.stack([each.time_ns for each in started], axis=1),
        np.full(runs, -1),
    )
    return carried, map_of_runs(whole["/landmarks"])


def run(
    state: tuple[Carried, Landmarks],
    block: Block,
    *,
    name: str,
    prefixes: tuple[str, ...],
    mode: Mode,
    settings: Settings,
) -> tuple[tuple[Carried, Landmarks], list[Ragged]]:
    """Filter a block; see `replay.engine.Recursive`."""
    before, landmarks = state
    carried = copy.deepcopy(before)
    events = _events(block, landmarks, prefixes, settings, carried.time_ns)
    count = int(events.emit.max(initial=-1)) + 1
    results = Results(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan))
    _compiled(mode)(len(carried.mean), events, landmarks.positions, settings, carried, results)
    emitting = np.flatnonzero(events.emit >= 0)
    good = np.isfinite(results.mean[:, 0])
    outputs = []
    for robot, prefix in enumerate(prefixes):
        chosen = (events.robot[emitting] == robot) & good
        rows = emitting[chosen]
        poses = results.mean[chosen]
        poses[:, 2] = wrap_angle(poses[:, 2])
        stream = make_stream(
            f"/estimates/{name}{prefix}/pose",
            schemas.GAUSSIAN_ESTIMATE,
            events.time_ns[rows],
            metadata={
                "components": "x_m,y_m,heading_rad",
                "kinds": "linear,linear,angle",
                "truth": f"{prefix}/truth",
            },
            mean=poses,
            covariance=results.covariance[chosen].reshape(-1, 9),
        )
        outputs.append(Ragged(stream, np.searchsorted(rows, events.offsets)))
    failed = np.flatnonzero((carried.failure >= 0) & (before.failure < 0))
    failure = make_stream(
        f"/estimates/{name}/failure",
        schemas.FAILURE,
        carried.time_ns[failed].max(axis=1),
        metadata={"reasons": "; ".join(FAILURES)},
        reason=carried.failure[failed],
    )
    offsets = np.searchsorted(failed, np.arange(len(carried.failure) + 1))
    return (carried, landmarks), [*outputs, Ragged(failure, offsets)]


def _events(
    block: Block,
    landmarks: Landmarks,
    prefixes: tuple[str, ...],
    settings: Settings,
    start_ns: Integers,
) -> Events:
    """The block's events as columns; a robot's estimate is due at its odometry."""
    order = block.events
    value = np.stack(
        [block.column("forward_mps", "range_m"), block.column("turn_radps", "bearing_rad")], axis=1
    )
    target_id = block.column("target_id", missing=0).astype(np.int64)
    run_of = np.repeat(np.arange(len(order.offsets) - 1), np.diff(order.offsets))
    robot, sees = np.divmod(order.topic, 2)
    numbers = np.array([_number(prefix) for prefix in prefixes])
    fellow = np.minimum(np.searchsorted(numbers, target_id), len(numbers) - 1)
    is_fellow = (numbers[fellow] == target_id) & (fellow != robot)
    row = rows_on_map(landmarks, (run_of << 32) + target_id)
    mapped = (row >= 0) & settings.anchor[robot]
    target = np.where(sees == 0, -1, np.where(is_fellow, fellow, len(numbers) + row))
    used = (sees == 0) | is_fellow | mapped
    due = (sees == 0) & (order.time_ns >= start_ns[run_of, robot])
    kept = np.flatnonzero(used)
    offsets = np.searchsorted(kept, order.offsets)
    emit = np.where(due[kept], np.cumsum(due[kept]) - 1, -1)
    return Events(offsets, order.time_ns[kept], robot[kept], target[kept], value[kept], emit)


def _number(prefix: str) -> int:
    return int(prefix.removeprefix("/robot"))


def _bind(name: str, topics: Mapping[str, Topic], parameters: CooperativeParameters) -> list[Bound]:
    """One filter for all robots that have odometry, range-bearings and a prior."""
    prefixes = tuple(
        sorted(
            (
                prefix
                for prefix in (
                    topic.rpartition("/")[0] for topic in topics if topic.endswith("/odometry")
                )
                if prefix.removeprefix("/robot").isdigit()
                and {f"{prefix}/range_bearing", f"{prefix}/prior"} <= topics.keys()
            ),
            key=_number,
        )
    )
    if len(prefixes) < 2 or "/landmarks" not in topics:
        return []
    density, variance = np.empty((len(prefixes), 2)), np.empty((len(prefixes), 2))
    for row, prefix in enumerate(prefixes):
        for column, key in enumerate(("forward_noise_density", "turn_noise_density")):
            given = getattr(parameters, key)
            density[row, column] = stated(topics[f"{prefix}/odometry"], key, given)
        for column, key in enumerate(("sigma_range_m", "sigma_bearing_rad")):
            given = getattr(parameters, key)
            variance[row, column] = stated(topics[f"{prefix}/range_bearing"], key, given) ** 2
    settings = Settings(
        density,
        variance,
        np.array([_number(prefix) in parameters.anchors for prefix in prefixes]),
        np.array([np.inf, *chi2.ppf(parameters.gate_probability, [1, 2])]),
    )
    return [
        Recursive(
            name,
            tuple(f"{prefix}/{leaf}" for prefix in prefixes for leaf in ("odometry", "range_bearing")),
            (*(f"{prefix}/prior" for prefix in prefixes), "/landmarks"),
            partial(begin, prefixes=prefixes),
            partial(run, name=name, prefixes=prefixes, mode=parameters.mode, settings=settings),
        )
    ]


COOPERATIVE = Estimator(
    "robots that share position estimates when they see each other: alone, naive, ci, joint",
    "/landmarks and, for two robots or more, .../odometry, .../range_bearing and .../prior",
    CooperativeParameters,
    _bind,
    variant="mode",
)
