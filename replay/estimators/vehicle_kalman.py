"""The Kalman filter of one vehicle from its own fixes: the paper's reference, association known.

Source: Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on
the symmetric measurement equation filter", 2016, section 4.1. Each vehicle is an estimate of its own.
"""

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from recorders.log import schemas
from recorders.models.states import PLANE_MOTION
from recorders.models.vehicles import noise_moments, turn
from recorders.parameters import Parameters
from replay.measurements import PLANE, Vectors
from replay.plain import Floats, Given, Integers, Messages, Results, recursive


class KalmanParameters(Parameters):
    """How the vehicle is supposed to move; None takes what its prior's channel states.

    A fix without a covariance has `sigma_fix_m` in both directions; without that it is not used.
    """

    turn_rate_radps: float | None = None
    acceleration_sigma_mps2: NonNegativeFloat | None = None
    sigma_fix_m: PositiveFloat | None = None


class Motion(NamedTuple):
    """How the vehicle moves."""

    turn_rate_radps: float
    acceleration_sigma_mps2: float


class State(NamedTuple):
    """The Gaussians (runs, 4), (runs, 4, 4), and what the prediction works in (runs, 4, 4)."""

    mean: Floats
    covariance: Floats
    time_ns: Integers
    transition: Floats
    product: Floats


def start(given: Given[KalmanParameters]) -> tuple[Motion, State]:
    """The state at every run's prior."""
    time_ns, mean, covariance = given.prior("prior")
    motion = Motion(
        given.stated("prior", "turn_rate_radps"), given.stated("prior", "acceleration_sigma_mps2")
    )
    scratch = np.zeros_like(covariance)
    return motion, State(mean, covariance, time_ns, scratch, scratch.copy())


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


VEHICLE_KALMAN = recursive(
    "Kalman filter of each vehicle from its own fixes",
    parameters=KalmanParameters,
    streams={"fix": schemas.POSITION_FIX},
    whole={"prior": schemas.GAUSSIAN_ESTIMATE},
    components=dict.fromkeys(PLANE_MOTION, "linear"),
    truth="truth",
    measured=PLANE,
    vectors={"fix": Vectors({"position_m": PLANE}, "covariance_m2", "sigma_fix_m")},
    start=start,
    follow=follow,
)
