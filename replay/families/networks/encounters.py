"""Moves robots by their odometry, and fuses their estimates where they see each other."""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.planar import drive
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.estimators.landmarks import POSE, sight
from fuselog.replay.families.networks.estimates import blend
from fuselog.replay.families.networks.pairwise import Stake, sighting_weight
from fuselog.replay.inference.kalman.steps import NOT_FINITE, NOT_POSITIVE_DEFINITE, UNKNOWN
from fuselog.replay.inference.linear_algebra.gaussian import add_through, copy_gaussian, wrap
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative
from fuselog.replay.inference.linear_algebra.small_matrices import UpdateMemory, update
from fuselog.replay.tracing.functions import traced


class RobotStates(NamedTuple):
    """Holds the robots' states between blocks; first axis = run. `failure` is one of gaussian's.

    The mean (3 n,) and covariance (3 n, 3 n) are of all n robots; only the joint filter has entries
    between robots.
    """

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: Integers
    failure: Integers


class RobotSettings(NamedTuple):
    """Holds the noise of the robots' odometry and sensors, both (n, 2), the anchors, and the gate."""

    density: Floats
    variance: Floats
    anchor: Booleans
    gate: Floats


class SightingFusion(NamedTuple):
    """Chooses how a sighting of another robot is used: one state of all, intersection, or naively.

    The weight of an intersection is that of the least trace or else of the least determinant.
    """

    joint: bool
    intersect: bool
    by_trace: bool


class RobotEvents(NamedTuple):
    """Holds the events of all runs in order: whose they are, and what they say.

    `robots` (m, 2) are the one that speaks and the one that it sees, -1 where it sees none. Odometry has
    the value (forward, turn) and `is_sighting` false; a sighting has (range, bearing), of a robot or of
    a landmark's `place` (m, 2). `is_due` says that the speaker's estimate is wanted.
    """

    offsets: Integers
    time_ns: Integers
    robots: Integers
    is_sighting: Booleans
    place: Floats
    value: Floats
    is_due: Booleans


class RobotInputs(NamedTuple):
    """Holds what the robots go by."""

    events: RobotEvents
    settings: RobotSettings
    fusion: SightingFusion


class RobotResults(NamedTuple):
    """Holds the robot's pose (m, 3) and covariance (m, 3, 3) after an event; NaN if not wanted."""

    mean: Floats
    covariance: Floats


class RobotMemory(NamedTuple):
    """Holds what the kernel works in, for one run.

    Attributes:
        state, transition, gain, variances: of a drive (3,), (3, 3), (3, 2), (2,).
        predicted, rows: of a sighting (2,), and by the pose that sees (2, 3).
        both: the same by the pose that sees and the one that is seen, (2, 2, 3).
        spread, square: H P H' and H P P H' of both, (2, 2, 2).
        whole: rows by the state of all robots, (2, 3 n).
        product: (3, 3 n).
        update: see `fuselog.replay.inference.linear_algebra.small_matrices`.
    """

    state: Floats
    transition: Floats
    gain: Floats
    variances: Floats
    predicted: Floats
    rows: Floats
    both: Floats
    spread: Floats
    square: Floats
    whole: Floats
    product: Floats
    update: UpdateMemory


KINDS = tuple(POSE.values())


linear_drive = derivative(
    traced(drive, 3, 2, None),
    [Input("pose", KINDS, "transition"), Input("velocity", ("linear", "linear"), "gain")],
    KINDS,
    "state",
)


linear_sight = derivative(
    traced(sight, 3, 2), [Input("pose", KINDS, "rows")], ("linear", "angle"), "predicted"
)


def advance(
    carried: RobotStates, run: int, robot: int, time_ns: int, density: Floats, work: RobotMemory
) -> None:
    """Move one robot to a time by its odometry, with its correlations.

    Args:
        carried: the robots of all runs, changed in place.
        run, robot: which.
        time_ns: nothing is done where the robot is there already.
        density: of the odometry's noise, forward and turn, (2,).
        work: to work in.
    """
    duration_s = (time_ns - carried.time_ns[run, robot]) * 1e-9
    if duration_s <= 0.0:
        return
    carried.time_ns[run, robot] = time_ns
    mean, covariance, first = carried.mean[run], carried.covariance[run], 3 * robot
    velocity = carried.velocity[run, robot]
    pose = (mean[first], mean[first + 1], mean[first + 2])
    linear_drive(pose, (velocity[0], velocity[1]), duration_s, work)
    mean[first : first + 3] = work.state
    for k in range(2):
        work.variances[k] = density[k] * density[k] / duration_s
    for row in range(3):
        for column in range(len(mean)):
            work.product[row, column] = 0.0
            for k in range(3):
                work.product[row, column] += work.transition[row, k] * covariance[first + k, column]
    own = work.product[:, first : first + 3]
    fill_spread(covariance, first, work.transition, own)
    add_through(own, work.gain, work.variances)
    for row in range(3):
        for column in range(len(mean)):
            covariance[first + row, column] = covariance[column, first + row] = work.product[row, column]


def fill_spread(covariance: Floats, first: int, rows: Floats, spread: Floats) -> None:
    """Fill rows P rows' with the block P (3, 3) of one robot; symmetric by construction.

    Args:
        covariance: (3 n, 3 n) of all robots.
        first: where the robot's block begins.
        rows: (k, 3).
        spread: (k, k), overwritten.
    """
    for row in range(len(rows)):
        for column in range(row + 1):
            entry = 0.0
            for k in range(3):
                for m in range(3):
                    entry += rows[row, k] * covariance[first + k, first + m] * rows[column, m]
            spread[row, column] = spread[column, row] = entry


def look(
    mean: Floats,
    robot: int,
    place: tuple[float, float],
    value: Floats,
    difference: Floats,
    work: RobotMemory,
) -> None:
    """Fill the innovation of a robot's sighting of a place, and its rows by both robots.

    Args:
        mean: (3 n,) of all robots.
        robot: the one that sees.
        place: x and y in m, of a landmark or of the robot that is seen.
        value: range in m and bearing in rad, (2,).
        difference: (2,), overwritten.
        work: whose `both` is filled.
    """
    first = 3 * robot
    linear_sight((mean[first], mean[first + 1], mean[first + 2]), place, work)
    for row in range(2):
        difference[row] = wrap(value[row] - work.predicted[row], row == 1)
        for k in range(3):
            work.both[0, row, k] = work.rows[row, k]
            work.both[1, row, k] = -work.rows[row, k] if k < 2 else 0.0


def see_through(covariance: Floats, first: int, side: int, work: RobotMemory) -> float:
    """Fill what a sighting says of one robot's block of the covariance; returns the block's trace.

    Args:
        covariance, first: as for `fill_spread`.
        side: 0 for the robot that sees, 1 for the one that is seen.
        work: with `both`; `spread` and `square` of this side are filled.
    """
    rows, trace = work.both[side], 0.0
    fill_spread(covariance, first, rows, work.spread[side])
    for k in range(3):
        trace += covariance[first + k, first + k]
        for row in range(2):
            work.rows[row, k] = 0.0
            for m in range(3):
                work.rows[row, k] += covariance[first + k, first + m] * rows[row, m]
    for row in range(2):
        for column in range(2):
            work.square[side, row, column] = 0.0
            for k in range(3):
                work.square[side, row, column] += work.rows[row, k] * work.rows[column, k]
    return trace


def scale(covariance: Floats, first: int, factor: float) -> None:
    """Scale the block of one robot, in place.

    Args:
        covariance, first: as for `fill_spread`.
        factor: by which.
    """
    for row in range(3):
        for column in range(3):
            covariance[first + row, first + column] *= factor


def meet(
    mean: Floats,
    covariance: Floats,
    robots: Integers,
    difference: Floats,
    variance: Floats,
    gate: float,
    fusion: SightingFusion,
    work: RobotMemory,
) -> bool:
    """Use a sighting; False where a covariance is not positive definite.

    Args:
        mean, covariance: (3 n,), (3 n, 3 n) of all robots, changed in place.
        robots: the one that sees and the one that is seen, -1 for a landmark, (2,).
        difference: the innovation (2,), see `look`.
        variance: of range and bearing, (2,).
        gate: the largest squared distance of what is used.
        fusion: how another robot's estimate is used.
        work: with `both` by `look`.
    """
    own, noise, traces = np.zeros((2, 2)), np.empty((2, 2)), np.zeros(2)
    first, both = (3 * robots[0], 3 * robots[1]), robots[1] >= 0
    for row in range(2):
        own[row, row] = variance[row]
    for side in range(1 + both):
        traces[side] = see_through(covariance, first[side], side, work)
    for side in range(1 + (both and not fusion.joint)):
        weight, share = 1.0, 0.0
        if both and not fusion.joint:
            share = 1.0
            if fusion.intersect:
                stake = Stake(3, traces[side], work.spread[side], work.square[side])
                weight = sighting_weight(fusion.by_trace, stake, work.spread[1 - side], own)
                share = 1.0 / (1.0 - weight)
        blend(1.0, own, share, work.spread[1 - side], noise)
        scale(covariance, first[side], 1.0 / weight)
        work.whole[:] = 0.0
        for other in range(side, side + 1 + (both and fusion.joint)):
            work.whole[:, first[other] : first[other] + 3] = work.both[other]
        squared = update(mean, covariance, difference, work.whole, noise, work.update, gate)
        if np.isnan(squared):
            return False
        if not squared <= gate:
            scale(covariance, first[side], weight)
    return True


def cooperate(
    run: int,
    event: int,
    inputs: RobotInputs,
    carried: RobotStates,
    results: RobotResults,
    work: RobotMemory,
) -> int:
    """Move the robots of an event to its time, and use it unless it is from before the robot's own."""
    events, settings, fusion = inputs
    mean, covariance = carried.mean[run], carried.covariance[run]
    difference = np.empty(2)
    robots, now = events.robots[event], events.time_ns[event]
    robot, seen = robots[0], robots[1]
    if now < carried.time_ns[run, robot]:
        return UNKNOWN
    for side in range(2):
        if robots[side] >= 0:
            density = settings.density[robots[side]]
            advance(carried, run, robots[side], now, density, work)
    if events.is_sighting[event]:
        place = (events.place[event, 0], events.place[event, 1])
        if seen >= 0:
            place = (mean[3 * seen], mean[3 * seen + 1])
        look(mean, robot, place, events.value[event], difference, work)
        measured, variance = 0, settings.variance[robot]
        for k in range(2):
            measured += not np.isnan(difference[k])
        gate = settings.gate[measured]
        if measured > 0 and not meet(mean, covariance, robots, difference, variance, gate, fusion, work):
            return NOT_POSITIVE_DEFINITE
    else:
        carried.velocity[run, robot] = events.value[event]
    total = 0.0
    for row in range(len(mean)):
        total += mean[row]
    return ALL_WELL if np.isfinite(total) else NOT_FINITE


def write_pose(
    run: int,
    event: int,
    inputs: RobotInputs,
    carried: RobotStates,
    results: RobotResults,
    work: RobotMemory,
) -> int:
    """Fill in the pose of the robot that an event is of, where it is wanted."""
    if inputs.events.is_due[event]:
        first = 3 * inputs.events.robots[event, 0]
        mean, covariance = carried.mean[run], carried.covariance[run]
        own = covariance[first : first + 3, first : first + 3]
        copy_gaussian(mean[first : first + 3], own, results.mean[event], results.covariance[event])
    return ALL_WELL
