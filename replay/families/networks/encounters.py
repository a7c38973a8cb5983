"""Prediction of robots by odometry, and fusion of two robots' estimates when they see each other."""

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
    """States of the robots between blocks, by run; `failure` is an error code of `gaussian`.

    The mean (3 n,) and covariance (3 n, 3 n) cover all n robots. Only the joint filter has covariances
    between robots.
    """

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: Integers
    failure: Integers


class RobotSettings(NamedTuple):
    """Noise of odometry and sensors, (n, 2) each, with the anchors and the gate."""

    density: Floats
    variance: Floats
    anchor: Booleans
    gate: Floats


class SightingFusion(NamedTuple):
    """Method of using a sighting of another robot: one joint state, intersection, or naive fusion.

    The weight of an intersection minimizes the trace if `by_trace` is true, otherwise the determinant.
    """

    joint: bool
    intersect: bool
    by_trace: bool


class RobotEvents(NamedTuple):
    """Events of all runs in order, with their robots and values.

    `robots` (m, 2) has the robot that sent the event and the robot that it sees, or -1 if it sees none.
    For odometry, the value is (forward, turn) and `is_sighting` is false. For a sighting of a robot or
    of a landmark at `place` (m, 2), the value is (range, bearing). `is_due` marks events at which the
    estimate of the sending robot is written.
    """

    offsets: Integers
    time_ns: Integers
    robots: Integers
    is_sighting: Booleans
    place: Floats
    value: Floats
    is_due: Booleans


class RobotInputs(NamedTuple):
    """Inputs of the cooperative filter."""

    events: RobotEvents
    settings: RobotSettings
    fusion: SightingFusion


class RobotResults(NamedTuple):
    """Poses (m, 3) of robots and covariances (m, 3, 3) after the events; NaN if `is_due` is false."""

    mean: Floats
    covariance: Floats


class RobotMemory(NamedTuple):
    """Scratch memory of the kernel, for one run.

    Attributes:
        state, transition, gain, variances: quantities of a prediction, (3,), (3, 3), (3, 2), (2,).
        predicted, rows: predicted sighting (2,), and its Jacobian for the observer's pose (2, 3).
        both: Jacobians for the poses of the observer and of the observed robot, (2, 2, 3).
        spread, square: H P H' and H P P H' of both robots, (2, 2, 2).
        whole: Jacobian for the state of all robots, (2, 3 n).
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
    """Predict one robot and its correlations to a given time, using the robot's odometry.

    Args:
        carried: the robots of all runs, changed in place.
        run, robot: the run and the robot.
        time_ns: time to predict to; if the robot's state is at least as new, it is not changed.
        density: densities of the odometry's noise, forward and turn, (2,).
        work: scratch memory.
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
    """Compute `rows` P `rows`', exactly symmetric, for the block P (3, 3) of one robot.

    Args:
        covariance: (3 n, 3 n) of all robots.
        first: index at which the robot's block begins.
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
    """Compute the innovation of a sighting, and its Jacobians with respect to both robots.

    Args:
        mean: (3 n,) of all robots.
        robot: the observing robot.
        place: x and y, in m, of a landmark or of the observed robot.
        value: range in m and bearing in rad, (2,).
        difference: (2,), overwritten.
        work: scratch memory, whose `both` is overwritten.
    """
    first = 3 * robot
    linear_sight((mean[first], mean[first + 1], mean[first + 2]), place, work)
    for row in range(2):
        difference[row] = wrap(value[row] - work.predicted[row], row == 1)
        for k in range(3):
            work.both[0, row, k] = work.rows[row, k]
            work.both[1, row, k] = -work.rows[row, k] if k < 2 else 0.0


def see_through(covariance: Floats, first: int, side: int, work: RobotMemory) -> float:
    """Project one robot's block of the covariance onto a sighting; return the block's trace.

    Args:
        covariance, first: as for `fill_spread`.
        side: 0 for the observing robot, 1 for the observed robot.
        work: scratch memory with `both`; `spread` and `square` of this robot are overwritten.
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
        factor: factor by which the covariances of the block are multiplied.
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
    """Update with a sighting; return False if a covariance is not positive definite.

    Args:
        mean, covariance: (3 n,) and (3 n, 3 n), for the poses of all robots together; changed in place.
        robots: (2,), the observing robot and the observed robot, or -1 for a landmark.
        difference: the innovation (2,), see `look`.
        variance: variances of range and bearing, (2,).
        gate: largest squared distance at which a sighting is accepted.
        fusion: the method for using another robot's estimate.
        work: scratch memory in which `look` has filled `both`.
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
    """Predict an event's robots to its time, and process it unless the sender's state is newer."""
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
    """Write the pose of the robot that sent an event, if the pose is due."""
    if inputs.events.is_due[event]:
        first = 3 * inputs.events.robots[event, 0]
        mean, covariance = carried.mean[run], carried.covariance[run]
        own = covariance[first : first + 3, first : first + 3]
        copy_gaussian(mean[first : first + 3], own, results.mean[event], results.covariance[event])
    return ALL_WELL
