"""Dead reckoning with the gyro only, starting at the attitude of the unit at rest; see `inertial`."""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.inertial import triad
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.directional.distributions.bingham_kernels import compose
from fuselog.replay.families.directional.orientation.inertial import (
    InertialModel,
    InertialSamples,
    OrientationEstimates,
    over_runs,
    prepared,
)
from fuselog.replay.families.directional.orientation.triad import all_finite, turn_quaternion

NS = 1e-9


class ReckoningState(NamedTuple):
    """State of dead reckoning between samples; the first axis is the run.

    Attributes:
        orientation: (runs, 4), zero until the stationary period is over, NaN after a gap.
        time_ns: stamps of the first and the last sample, (runs, 2); -1 before they exist.
        sums: sums of gyro, accelerometer and magnetometer during the stationary period, (runs, 3, 3).
        rest_samples: number of samples in the sums, (runs,).
        rest_s: duration of the stationary period if it is shorter than in the model, (runs,).
    """

    orientation: Floats
    time_ns: Integers
    sums: Floats
    rest_samples: Integers
    rest_s: Floats


def start_reckoning(runs: int, rest_s: Floats | None = None) -> ReckoningState:
    """Return the state before the first sample.

    Args:
        runs: number of runs.
        rest_s: (runs,), durations of stationary periods that are shorter than in the model.
    """
    none_yet = np.full((runs, 2), -1)
    return ReckoningState(
        np.zeros((runs, 4)),
        none_yet,
        np.zeros((runs, 3, 3)),
        np.zeros(runs, np.int64),
        np.full(runs, np.inf) if rest_s is None else rest_s,
    )


def run_dead_reckoning(
    model: InertialModel,
    state: ReckoningState,
    samples: InertialSamples,
    estimates: OrientationEstimates | None = None,
    *,
    unbiased: bool,
) -> tuple[ReckoningState, OrientationEstimates]:
    """Integrate the gyro from the attitude at rest; if `unbiased`, subtract the gyro's mean at rest.

    There are no estimates before the end of the stationary period or after a gap. Args and errors as for
    `run_inertial_filter`.
    """
    samples, estimates = prepared(model, samples, estimates)
    state = ReckoningState._make(part.copy() for part in state)
    over_runs(_reckoning_run)(len(samples.offsets) - 1, model, unbiased, state, samples, estimates)
    return state, estimates


def _reckoning_run(
    run: int,
    model: InertialModel,
    unbiased: bool,
    state: ReckoningState,
    samples: InertialSamples,
    estimates: OrientationEstimates,
) -> None:
    for row in range(samples.offsets[run], samples.offsets[run + 1]):
        _reckon(model, unbiased, state, run, samples, estimates, row)


def _reckon(
    model: InertialModel,
    unbiased: bool,
    state: ReckoningState,
    run: int,
    samples: InertialSamples,
    estimates: OrientationEstimates,
    row: int,
) -> None:
    """Process one sample; skip it if force or rate is not finite; a field may be missing."""
    time_ns, rate = samples.time_ns[row], samples.rate[row]
    force, field = samples.force[row], samples.field[row]
    if not all_finite(rate, force, force):
        return
    orientation, times, sums = state.orientation[run], state.time_ns[run], state.sums[run]
    if times[0] < 0:
        times[:] = time_ns
    duration_s, elapsed_s = (time_ns - times[1]) * NS, (time_ns - times[0]) * NS
    times[1] = time_ns
    if duration_s > model.gap_s:
        orientation[:] = np.nan
    rest_s = min(model.rest_s, state.rest_s[run])
    if elapsed_s < rest_s:
        for i in range(3):
            sums[0, i] += rate[i]
            sums[1, i] += force[i]
            if all_finite(field, field, field):
                sums[2, i] += field[i]
        state.rest_samples[run] += 1
        return
    is_blank = True
    for i in range(4):
        is_blank = is_blank and orientation[i] == 0.0
    if is_blank:
        orientation[0], orientation[1], orientation[2], orientation[3] = triad(sums[1], sums[2])
    turn, count = np.empty(3), max(state.rest_samples[run], 1)
    for i in range(3):
        turn[i] = (rate[i] - (sums[0, i] / count if unbiased else 0.0)) * duration_s
    compose(orientation.copy(), turn_quaternion(turn[0], turn[1], turn[2]), orientation)
    estimates.orientation[row] = orientation
    variance = model.attitude_sigma_rad**2 + model.drift_sigma_rad**2 * (elapsed_s - rest_s)
    for i in range(3):
        for j in range(3):
            estimates.covariance[row, i, j] = variance if i == j else 0.0
