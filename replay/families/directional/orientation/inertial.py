"""Orientation from inertial and magnetic samples by dead reckoning and a Bingham filter.

The module also has a baseline, the attitude from every single sample. Dead reckoning with the gyro only
is in `reckoning`.

The filter was made for the BROAD benchmark (Laidig, Caruso, Cereatti, Seel, "BROAD", Data 6(7), 2021).
At first the body is stationary; the mean of the gyro during this period is the gyro's bias. Then, for
each block of time, the samples of accelerometer and magnetometer are rotated into the frame at the end
of the block, by the rotation that the gyro measured, and averaged, which separates gravity from motion.
The TRIAD attitude of the averages is a quaternion measurement for the filter. Quaternions rotate vectors
from body axes to east, north, up.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.inertial import triad
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.directional.distributions.bingham_kernels import (
    compose,
    integrate,
    local_moments,
    predict,
    turn_columns,
    update,
)
from fuselog.replay.families.directional.orientation.triad import (
    all_finite,
    fill_diagonal,
    fill_isotropic,
    turn_back,
    turn_quaternion,
)

_NS = 1e-9


class InertialModel(NamedTuple):
    """Assumptions of the filter, the same for all logs.

    Attributes:
        rest_s: longest duration of the stationary period at the start.
        block_s: averaging time of one attitude.
        attitude_sigma_rad: standard deviation of a block's attitude about each axis.
        drift_sigma_rad: standard deviation, about each axis, of dead reckoning over one second.
        gap_s: time between two samples above which the orientation becomes unknown.
    """

    rest_s: float = 20.0
    block_s: float = 1.0
    attitude_sigma_rad: float = math.radians(10.0)
    drift_sigma_rad: float = math.radians(0.4)
    gap_s: float = 0.1


class InertialSamples(NamedTuple):
    """Samples of many runs in time order; rows offsets[r]:offsets[r + 1] belong to run r.

    Attributes:
        offsets: (runs + 1,).
        time_ns: (rows,).
        rate: gyro, rad/s, (rows, 3).
        force: accelerometer, (rows, 3), any unit; points up at rest.
        field: magnetometer, (rows, 3), any unit.
    """

    offsets: Integers
    time_ns: Integers
    rate: Floats
    force: Floats
    field: Floats


class InertialState(NamedTuple):
    """State of the filter between samples; the first axis is the run.

    Attributes:
        time_ns: stamps of the first sample, the last sample and the start of the block, (runs, 3); -1
            before they exist.
        rate_sum: sum of the gyro's samples during the stationary period, (runs, 3).
        rest_samples: number of samples in rate_sum, (runs,).
        axes: axes of the Bingham distribution at the start of the block, (runs, 4, 4).
        concentrations: (runs, 4), all 0 while the orientation is unknown.
        covariance: covariance of the orientation error as a rotation vector in body axes, in rad^2,
            (runs, 3, 3).
        increment: the rotation since the start of the block, (runs, 4).
        force: sum of the accelerometer's samples in the block, rotated into the frame of the last
            sample, (runs, 3).
        field: sum of the magnetometer's samples in the block, rotated in the same way, (runs, 3).
        rest_s: duration of the stationary period if it is shorter than in the model, (runs,).
    """

    time_ns: Integers
    rate_sum: Floats
    rest_samples: Integers
    axes: Floats
    concentrations: Floats
    covariance: Floats
    increment: Floats
    force: Floats
    field: Floats
    rest_s: Floats


class OrientationEstimates(NamedTuple):
    """Orientation (rows, 4) of every sample, and covariance in the body frame (rows, 3, 3).

    Both are NaN while the orientation is unknown and if a sample is not finite.
    """

    orientation: Floats
    covariance: Floats


def start_inertial_filter(runs: int, rest_s: Floats | None = None) -> InertialState:
    """Return the state before the first sample.

    Args:
        runs: number of runs.
        rest_s: (runs,), durations of stationary periods that are shorter than in the model.
    """
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
        np.full(runs, np.inf) if rest_s is None else rest_s,
    )


@cache
def over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    """Compile a loop over runs that calls a function for the samples of each run."""
    return compile_over_runs(run_once)


def run_inertial_filter(
    model: InertialModel,
    state: InertialState,
    samples: InertialSamples,
    estimates: OrientationEstimates | None = None,
) -> tuple[InertialState, OrientationEstimates]:
    """Process the samples of an ensemble; return the state after them and the estimates.

    If `estimates` is given, it must be NaN everywhere and is filled. Raises BadInput if the columns have
    different lengths, if `rest_s` is negative, or if another value in the model is not positive.
    """
    samples, estimates = prepared(model, samples, estimates)
    state = InertialState._make(part.copy() for part in state)
    over_runs(_inertial_run)(len(samples.offsets) - 1, model, state, samples, estimates)
    return state, estimates


def attitudes(
    model: InertialModel, samples: InertialSamples, estimates: OrientationEstimates | None = None
) -> OrientationEstimates:
    """Compute the TRIAD attitude of every sample, as if the specific force were only gravity.

    Args and errors as for `run_inertial_filter`.
    """
    samples, estimates = prepared(model, samples, estimates)
    rows = len(samples.force)
    over_runs(_attitude)(rows, samples.force, samples.field, estimates.orientation)
    estimates.covariance[:] = model.attitude_sigma_rad**2 * np.eye(3)
    return estimates


def prepared(
    model: InertialModel, samples: InertialSamples, estimates: OrientationEstimates | None
) -> tuple[InertialSamples, OrientationEstimates]:
    """Check samples, and return them with the estimates to fill; see `run_inertial_filter`.

    Args:
        model: assumptions of the filter.
        samples: samples of all runs.
        estimates: estimates to fill, all NaN; if None, they are allocated.
    """
    rows = int(samples.offsets[-1])
    if any(column.shape != (rows, 3) for column in samples[2:]) or samples.time_ns.shape != (rows,):
        raise BadInput(
            "every inertial sample needs a time, and 3 numbers each for turn rate, specific force and "
            "magnetic field"
        )
    if not min(model[1:]) > 0.0 or model.rest_s < 0.0:
        raise BadInput(
            "block_s, gap_s and the standard deviations of an inertial filter must be positive"
        )
    if estimates is None:
        estimates = OrientationEstimates(np.full((rows, 4), np.nan), np.full((rows, 3, 3), np.nan))
    return InertialSamples._make(map(np.ascontiguousarray, samples)), estimates


def _attitude(row: int, force: NDArray, field: NDArray, orientation: NDArray) -> None:
    found = triad(force[row], field[row])
    for part in range(4):
        orientation[row, part] = found[part]


def _inertial_run(
    run: int,
    model: InertialModel,
    state: InertialState,
    samples: InertialSamples,
    estimates: OrientationEstimates,
) -> None:
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
    """Add one sample to the sums of the stationary period and of the block, in place.

    Returns the time in s since the start of the block, or NaN if the sample is skipped because it is not
    finite. If only the field is not finite, as between two samples of a slower magnetometer, force and
    turn rate are still used.
    """
    time_ns, rate = samples.time_ns[row], samples.rate[row]
    force, field = samples.force[row], samples.field[row]
    if not all_finite(rate, force, force):
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
    if (time_ns - times[0]) * _NS < min(model.rest_s, state.rest_s[run]):
        for i in range(3):
            state.rate_sum[run, i] += rate[i]
        state.rest_samples[run] += 1
    else:
        bias, count = state.rate_sum[run], max(state.rest_samples[run], 1)
        increment = state.increment[run]
        step = turn_quaternion(
            (rate[0] - bias[0] / count) * duration_s,
            (rate[1] - bias[1] / count) * duration_s,
            (rate[2] - bias[2] / count) * duration_s,
        )
        compose((increment[0], increment[1], increment[2], increment[3]), step, increment)
        turn_back(step, state.force[run])
        turn_back(step, state.field[run])
    for i in range(3):
        state.force[run, i] += force[i]
        if all_finite(field, field, field):
            state.field[run, i] += field[i]
    return (time_ns - times[2]) * _NS


def _start_block(state: InertialState, run: int, time_ns: int) -> None:
    state.time_ns[run, 2] = time_ns
    state.increment[run] = 0.0
    state.increment[run, 0] = 1.0
    state.force[run] = 0.0
    state.field[run] = 0.0


def _end_block(model: InertialModel, state: InertialState, run: int, elapsed_s: float) -> None:
    """Predict over the block and update with its attitude; change the state in place."""
    axes, z = state.axes[run], state.concentrations[run]
    moments, noise, work = np.empty(4), np.empty(4), np.empty((4, 4))
    if z[0] < 0.0:
        turn_columns(axes, state.increment[run])
        fill_isotropic(model.drift_sigma_rad * math.sqrt(elapsed_s), noise)
        integrate(noise, moments, work)
        fill_diagonal(moments, work)
        predict(axes, z, work)
    attitude = triad(state.force[run], state.field[run])
    if math.isfinite(attitude[0]):
        fill_isotropic(model.attitude_sigma_rad, noise)
        fill_diagonal(noise, work)
        update(axes, z, work, attitude)
    local_moments(axes, z, moments, work)
    for i in range(3):
        for j in range(3):
            # a small rotation vector is twice the vector part of its quaternion
            state.covariance[run, i, j] = 4.0 * work[i + 1, j + 1]
    _start_block(state, run, state.time_ns[run, 1])


def _dead_reckon(
    model: InertialModel,
    state: InertialState,
    run: int,
    elapsed_s: float,
    estimates: OrientationEstimates,
    row: int,
) -> None:
    """Write the orientation and covariance after the block's increment, including its noise."""
    increment, covariance = state.increment[run], estimates.covariance[row]
    compose(state.axes[run, :, 3], increment, estimates.orientation[row])
    covariance[:, :] = state.covariance[run]
    for i in range(3):
        turn_back(increment, covariance[i])
    for i in range(3):
        turn_back(increment, covariance[:, i])
        covariance[i, i] += model.drift_sigma_rad**2 * elapsed_s
