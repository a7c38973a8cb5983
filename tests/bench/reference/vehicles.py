"""Frozen reference: the Kalman filter of one vehicle from its own fixes, specialised by hand.

As it was before filters were made from models (issue 13), to be timed against and for nothing else.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from tests.bench.reference.gaussian import Floats, Function


class Messages(NamedTuple):
    """Fixes of all runs: run r owns offsets[r]:offsets[r + 1]; value (n, 6) is place and covariance."""

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    value: Floats


class Results(NamedTuple):
    """What the filter fills, one row for every fix."""

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats


def turn(
    state: tuple[float, float, float, float], turn_rate_radps: float, duration_s: float
) -> tuple[float, float, float, float]:
    """The state after a coordinated turn (14); a turn rate of zero is constant velocity (12)."""
    angle = turn_rate_radps * duration_s
    along = duration_s * np.sinc(angle / np.pi)
    across = duration_s * 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    cosine, sine = np.cos(angle), np.sin(angle)
    x, vx, y, vy = state
    return (
        x + along * vx - across * vy,
        cosine * vx - sine * vy,
        y + across * vx + along * vy,
        sine * vx + cosine * vy,
    )


def noise_moments(acceleration_sigma_mps2: float, duration_s: float) -> tuple[float, float, float]:
    """Variance of the position, covariance with the velocity, variance of the velocity, per axis.

    The acceleration is white and constant over the duration. (13) with T^4/4, T^3/2 and T^2, where the
    paper prints T^2/4, T^2/2 and T: the same for its T = 1.
    """
    velocity = (acceleration_sigma_mps2 * duration_s) ** 2
    return 0.25 * velocity * duration_s**2, 0.5 * velocity * duration_s, velocity


class Motion(NamedTuple):
    """How the vehicle moves."""

    turn_rate_radps: float
    acceleration_sigma_mps2: float


class State(NamedTuple):
    """The Gaussians (runs, 4), (runs, 4, 4), and what the prediction works in (runs, 4, 4)."""

    mean: Floats
    covariance: Floats
    time_ns: NDArray[np.int64]
    transition: Floats
    product: Floats


def move(
    motion: Motion,
    mean: Floats,
    covariance: Floats,
    duration_s: float,
    transition: Floats,
    product: Floats,
) -> None:
    """Predict in place; the other two arrays are scratch."""
    rate = motion.turn_rate_radps
    x, vx, y, vy = turn((mean[0], mean[1], mean[2], mean[3]), rate, duration_s)
    mean[0], mean[1], mean[2], mean[3] = x, vx, y, vy
    for column in range(4):
        unit = (1.0 * (column == 0), 1.0 * (column == 1), 1.0 * (column == 2), 1.0 * (column == 3))
        a, b, c, d = turn(unit, rate, duration_s)
        transition[0, column], transition[1, column] = a, b
        transition[2, column], transition[3, column] = c, d
    for i in range(4):
        for j in range(4):
            product[i, j] = 0.0
            for k in range(4):
                product[i, j] += transition[i, k] * covariance[k, j]
    position, cross, velocity = noise_moments(motion.acceleration_sigma_mps2, duration_s)
    for i in range(4):
        for j in range(i + 1):
            entry = 0.0
            for k in range(4):
                entry += product[i, k] * transition[j, k]
            if i == j:
                entry += position if i % 2 == 0 else velocity
            elif i == j + 1 and i % 2 == 1:
                entry += cross
            covariance[i, j] = entry
            covariance[j, i] = entry


def follow(run: int, motion: Motion, messages: Messages, state: State, results: Results) -> None:
    """Predict to every fix and update by it."""
    mean, covariance = state.mean[run], state.covariance[run]
    transition, cross = state.transition[run], state.product[run]
    for message in range(messages.offsets[run], messages.offsets[run + 1]):
        duration_s = (messages.time_ns[message] - state.time_ns[run]) * 1e-9
        fix = messages.value[message]
        if duration_s > 0.0:
            state.time_ns[run] = messages.time_ns[message]
            move(motion, mean, covariance, duration_s, transition, cross)
        a, b, c = covariance[0, 0] + fix[2], covariance[0, 2] + fix[3], covariance[2, 2] + fix[5]
        determinant = a * c - b * b
        u, v = fix[0] - mean[0], fix[1] - mean[2]
        for i in range(4):
            for k in range(2):
                cross[k, i] = covariance[i, 2 * k]
        for i in range(4):
            along = (c * cross[0, i] - b * cross[1, i]) / determinant
            across = (a * cross[1, i] - b * cross[0, i]) / determinant
            mean[i] += along * u + across * v
            for j in range(4):
                covariance[i, j] -= along * cross[0, j] + across * cross[1, j]
        for i in range(4):
            results.mean[message, i] = mean[i]
            for j in range(4):
                results.covariance[message, i, j] = covariance[i, j]
        results.innovation[message, 0], results.innovation[message, 1] = u, v
        results.innovation_covariance[message, 0, 0] = a
        results.innovation_covariance[message, 0, 1] = b
        results.innovation_covariance[message, 1, 0] = b
        results.innovation_covariance[message, 1, 1] = c
        results.squared[message] = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant


@cache
def compiled() -> Function:
    """The loop over the runs: (runs, motion, messages, state, results), which fills the last two."""
    return compile_over_runs(follow)
