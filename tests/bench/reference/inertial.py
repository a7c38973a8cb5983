"""Frozen reference: dead reckoning corrected by the Bingham filter, one loop over all runs.

As it was before filters were made from models (issue 13), to be timed against and for nothing else. What
a Bingham distribution is predicted and updated by is taken from
`fuselog.replay.families.directional.distributions`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.through_numba import numba_over_runs
from fuselog.replay.families.directional.distributions.bingham_kernels import (
    compose,
    compose_columns,
    integrate,
    predict,
    turn_columns,
    update,
    weighted_outer,
)

_NS = 1e-9


class InertialModel(NamedTuple):
    """What the filter takes for granted, the same for all logs.

    Attributes:
        rest_s: how long the body rests at the start.
        block_s: how much time is averaged into one attitude.
        attitude_sigma_rad: standard deviation of a block's attitude about each axis.
        drift_sigma_rad: standard deviation of one second's dead reckoning about each axis.
        gap_s: a longer gap between two samples makes the orientation unknown.
    """

    rest_s: float = 20.0
    block_s: float = 1.0
    attitude_sigma_rad: float = math.radians(10.0)
    drift_sigma_rad: float = math.radians(0.4)
    gap_s: float = 0.1


class InertialSamples(NamedTuple):
    """The samples of many runs end to end, in time order: run r owns offsets[r]:offsets[r + 1].

    Attributes:
        offsets: (runs + 1,).
        time_ns: (rows,).
        rate: gyro, rad/s, (rows, 3).
        force: accelerometer, (rows, 3), any unit: at rest it points up.
        field: magnetometer, (rows, 3), any unit.
    """

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    rate: NDArray[np.float64]
    force: NDArray[np.float64]
    field: NDArray[np.float64]


class InertialState(NamedTuple):
    """What the filter carries from sample to sample, first axis runs.

    Attributes:
        time_ns: of the first sample, the last one, the start of the block, (runs, 3); -1 for none yet.
        rate_sum: the gyro's sum over the rest (runs, 3).
        rest_samples: how many samples rate_sum has (runs,).
        axes: of the Bingham distribution at the start of the block (runs, 4, 4).
        concentrations: (runs, 4), all 0 while the orientation is unknown.
        covariance: of its error as a rotation vector in the body's frame, rad^2, (runs, 3, 3).
        increment: the rotation since, (runs, 4).
        force: sum over the block, carried to the last sample, (runs, 3).
        field: the same of the magnetometer, (runs, 3).
    """

    time_ns: NDArray[np.int64]
    rate_sum: NDArray[np.float64]
    rest_samples: NDArray[np.int64]
    axes: NDArray[np.float64]
    concentrations: NDArray[np.float64]
    covariance: NDArray[np.float64]
    increment: NDArray[np.float64]
    force: NDArray[np.float64]
    field: NDArray[np.float64]


class OrientationEstimates(NamedTuple):
    """Per sample: orientation (rows, 4) and covariance of its rotation vector, body frame, (rows, 3, 3).

    NaN while the orientation is unknown, and where a sample is not finite.
    """

    orientation: NDArray[np.float64]
    covariance: NDArray[np.float64]


def start_inertial_filter(runs: int) -> InertialState:
    """The state before the first sample: nothing known."""
    return InertialState(
        np.full((runs, 3), -1),
        np.zeros((runs, 3)),
        np.zeros(runs, np.int64),
        np.tile(np.eye(4), (runs, 1, 1)),
        np.zeros((runs, 4)),
        np.zeros((runs, 3, 3)),
        np.tile(np.eye(4)[0], (runs, 1)),
        np.zeros((runs, 3)),
        np.zeros((runs, 3)),
    )


def filter_runs(
    model: InertialModel,
    state: InertialState,
    samples: InertialSamples,
    estimates: OrientationEstimates,
) -> None:
    """Fill the estimates of all rows, and leave the state after the last in `state`."""
    compiled()(len(samples.offsets) - 1, model, state, samples, estimates)


@cache
def compiled() -> Callable[..., None]:
    """The loop over the runs."""
    return numba_over_runs(filter_run)


def filter_run(
    run: int,
    model: InertialModel,
    state: InertialState,
    samples: InertialSamples,
    estimates: OrientationEstimates,
) -> None:
    """The samples of one run."""
    for row in range(samples.offsets[run], samples.offsets[run + 1]):
        elapsed_s = _accumulate(model, state, run, samples, row)
        if elapsed_s >= model.block_s:
            _end_block(model, state, run, elapsed_s)
            elapsed_s = 0.0
        if elapsed_s >= 0.0 and state.concentrations[run, 0] < 0.0:
            _dead_reckon(model, state, run, elapsed_s, estimates, row)


def _accumulate(
    model: InertialModel, state: InertialState, run: int, samples: InertialSamples, row: int
) -> float:
    """Add one sample to the rest and to the block, in place.

    Returns the time (s) since the block's start, or NaN where the sample is not finite and passed over.
    """
    time_ns, rate, force, field = (
        samples.time_ns[row],
        samples.rate[row],
        samples.force[row],
        samples.field[row],
    )
    if not math.isfinite(rate.sum() + force.sum() + field.sum()):
        return math.nan
    times = state.time_ns[run]
    duration_s = (time_ns - times[1]) * _NS
    if times[0] < 0:
        times[0] = time_ns
    if times[1] < 0 or duration_s > model.gap_s:
        duration_s = 0.0
        state.concentrations[run] = 0.0
        _start_block(state, run, time_ns)
    times[1] = time_ns
    if (time_ns - times[0]) * _NS < model.rest_s:
        state.rate_sum[run] += rate
        state.rest_samples[run] += 1
    else:
        bias = state.rate_sum[run] / max(state.rest_samples[run], 1)
        step = _increment((rate - bias) * duration_s)
        compose(state.increment[run].copy(), step, state.increment[run])
        _carry(step, state.force[run])
        _carry(step, state.field[run])
    state.force[run] += force
    state.field[run] += field
    return (time_ns - times[2]) * _NS


def _start_block(state: InertialState, run: int, time_ns: int) -> None:
    state.time_ns[run, 2] = time_ns
    state.increment[run] = 0.0
    state.increment[run, 0] = 1.0
    state.force[run] = 0.0
    state.field[run] = 0.0


def _end_block(model: InertialModel, state: InertialState, run: int, elapsed_s: float) -> None:
    """One prediction over the block and one update with its attitude, in place."""
    axes, z = state.axes[run], state.concentrations[run]
    moments, work = np.empty(4), np.empty((4, 4))
    if z[0] < 0.0:
        turn_columns(axes, state.increment[run])
        integrate(_isotropic(model.drift_sigma_rad * math.sqrt(elapsed_s)), moments, work)
        predict(axes, z, _diagonal(moments))
    attitude = _triad(state.force[run], state.field[run])
    if math.isfinite(attitude[0]):
        update(axes, z, _diagonal(_isotropic(model.attitude_sigma_rad)), attitude)
    integrate(z, moments, work)
    local = np.empty((4, 4))
    compose_columns(_inverse(axes[:, 3]), axes, local)
    weighted_outer(local, moments, work)
    # a small rotation vector is twice the vector part of its quaternion
    state.covariance[run] = 4.0 * work[1:, 1:]
    _start_block(state, run, state.time_ns[run, 1])


def _dead_reckon(
    model: InertialModel,
    state: InertialState,
    run: int,
    elapsed_s: float,
    estimates: OrientationEstimates,
    row: int,
) -> None:
    """The orientation that the block's increment leads to, and the error that it adds."""
    increment, covariance = state.increment[run], estimates.covariance[row]
    compose(state.axes[run, :, 3], increment, estimates.orientation[row])
    for i in range(3):
        for j in range(3):
            covariance[i, j] = state.covariance[run, i, j]
    for i in range(3):
        _carry(increment, covariance[i])
    for i in range(3):
        _carry(increment, covariance[:, i])
        covariance[i, i] += model.drift_sigma_rad**2 * elapsed_s


def _inverse(x: NDArray) -> NDArray:
    out = -x
    out[0] = x[0]
    return out


def _isotropic(sigma_rad: float) -> NDArray:
    """Concentrations about the identity, in the order of a quaternion's components."""
    z = np.full(4, -2.0 / sigma_rad**2)
    z[0] = 0.0
    return z


def _increment(rotation_rad: NDArray) -> NDArray:
    """The quaternion of a rotation vector (3,)."""
    x, y, z = 0.5 * rotation_rad
    angle = math.sqrt(x * x + y * y + z * z)
    scale = math.sin(angle) / angle if angle > 0.0 else 1.0
    return np.array([math.cos(angle), scale * x, scale * y, scale * z])


def _carry(turned: NDArray, vector: NDArray) -> None:
    """What a fixed vector becomes, in place, in the frame of a body that has turned by a quaternion."""
    w, x, y, z = turned[0], -turned[1], -turned[2], -turned[3]
    a, b, c = vector
    d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    vector[0] = a + w * d + y * f - z * e
    vector[1] = b + w * e + z * d - x * f
    vector[2] = c + w * f + x * e - y * d


def _triad(force: NDArray, field: NDArray) -> NDArray:
    """The orientation (4,) under which force points up and field north; NaN where they are parallel."""
    up = force / math.sqrt((force**2).sum())
    east = _cross(field, up)
    east /= math.sqrt((east**2).sum())
    north = _cross(up, east)
    # 4 q q^T of the rotation matrix with these rows; its largest column has no cancellation
    outer = np.array(
        (
            (1.0 + east[0] + north[1] + up[2], up[1] - north[2], east[2] - up[0], north[0] - east[1]),
            (up[1] - north[2], 1.0 + east[0] - north[1] - up[2], east[1] + north[0], east[2] + up[0]),
            (east[2] - up[0], east[1] + north[0], 1.0 - east[0] + north[1] - up[2], north[2] + up[1]),
            (north[0] - east[1], east[2] + up[0], north[2] + up[1], 1.0 - east[0] - north[1] + up[2]),
        )
    )
    best = 0
    for i in range(1, 4):
        if outer[i, i] > outer[best, best]:
            best = i
    column = outer[best]
    return column / math.sqrt((column**2).sum())


def _cross(a: NDArray, b: NDArray) -> NDArray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _diagonal(values: NDArray) -> NDArray:
    out = np.zeros((len(values), len(values)))
    for i in range(len(values)):
        out[i, i] = values[i]
    return out
