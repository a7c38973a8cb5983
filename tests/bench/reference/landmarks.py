"""Frozen reference: the EKF and UKF of a robot among landmarks, specialised by hand.

As they were before filters were made from models (issue 13), to be timed against and for nothing else:
the state is (x_m, y_m, heading_rad), and every event an odometry's velocity or a sighting.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from tests.bench.reference.gaussian import (
    ALL_WELL,
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    Filter,
    Floats,
    Function,
    Innovation,
    Models,
    SampleSets,
    correct,
    is_finite,
    linearised,
    no_innovation,
    sampled,
    unscented,
)

Components = Any


class Carried(NamedTuple):
    """What a filter carries from block to block; first axis = run."""

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: NDArray[np.int64]
    failure: NDArray[np.int64]


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


def drive(pose: Components, velocity: Components, duration_s: float) -> tuple[float, float, float]:
    """The pose after `duration_s` at a constant forward velocity (m/s) and turn rate (rad/s): an arc."""
    half_turn = 0.5 * velocity[1] * duration_s
    chord = velocity[0] * duration_s * np.sinc(half_turn / np.pi)
    direction = pose[2] + half_turn
    return (
        pose[0] + chord * np.cos(direction),
        pose[1] + chord * np.sin(direction),
        pose[2] + velocity[1] * duration_s,
    )


def drive_jacobians(pose: Components, velocity: Components, duration_s: float) -> tuple[Any, Any, Any]:
    """How the arc's end (x, y) changes with the heading, the forward velocity and the turn rate.

    The other derivatives of `drive` are 0, 1, and d heading / d turn rate = duration. Scalars only.
    """
    half_turn = 0.5 * velocity[1] * duration_s
    ratio = np.sinc(half_turn / np.pi)
    chord = velocity[0] * duration_s * ratio
    direction = pose[2] + half_turn
    cosine, sine = np.cos(direction), np.sin(direction)
    # d sin(u)/u / du, by its series where the quotient loses digits
    small = abs(half_turn) < 1e-4
    slope = -half_turn / 3.0 if small else (np.cos(half_turn) - ratio) / half_turn
    stretch = velocity[0] * duration_s * slope
    half_s = 0.5 * duration_s
    return (
        (-chord * sine, chord * cosine),
        (duration_s * ratio * cosine, duration_s * ratio * sine),
        (half_s * (stretch * cosine - chord * sine), half_s * (stretch * sine + chord * cosine)),
    )


def range_bearing(pose: Components, target: Components) -> tuple[float, float]:
    """Distance (m) and bearing (rad, not wrapped) from a pose to a point."""
    dx = target[0] - pose[0]
    dy = target[1] - pose[1]
    return np.sqrt(dx * dx + dy * dy), np.arctan2(dy, dx) - pose[2]


def range_bearing_jacobian(pose: Components, target: Components) -> tuple[Any, Any]:
    """The Jacobian of `range_bearing` by the pose: one row (x, y, heading) each."""
    dx = target[0] - pose[0]
    dy = target[1] - pose[1]
    squared = dx * dx + dy * dy
    distance = np.sqrt(squared)
    return (
        (-dx / distance, -dy / distance, 0.0),
        (dy / squared, -dx / squared, -1.0),
    )


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


@cache
def compiled(kind: str, kappa: float = 0.0) -> Function:
    """The loop over the runs of the `ekf` or the `ukf`; it changes `carried`, and fills poses and looks.

    Its arguments are runs, events, positions, settings, carried, poses, looks.
    """
    steps = {"ekf": linearised, "ukf": sampled}[kind](MODELS)
    loop = compile_over_runs(localization(steps))
    scratch = partial(_scratch, steps.memory, unscented(3, kappa))
    return partial(loop, scratch=scratch)


def _scratch(memory: Function, sets: SampleSets) -> tuple[Innovation, Any]:
    return no_innovation(3, 2), memory(3, 2, 2, sets)
