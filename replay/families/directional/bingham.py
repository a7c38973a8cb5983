"""Filters of axes (d = 2) and orientations (d = 4): x+ = x (+) u (+) w and z = x (+) v.

The recursive Bingham filter of Kurz, Gilitschenski, Julier, Hanebeck, JAIF 9(2), 2014, and the modified
Kalman filters with which the paper compares it. All of them process an ensemble as ragged rows in
compiled loops, in parallel over the runs.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.orientation import require_unit
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.directional.distributions import bingham
from fuselog.replay.families.directional.distributions.bingham import Bingham
from fuselog.replay.families.directional.distributions.bingham_kernels import (
    compose,
    framed,
    inverse,
    local_moments,
    predict,
    turn_columns,
    update,
)
from fuselog.replay.families.directional.distributions.gaussian_kernels import condition


class Steps(NamedTuple):
    """Steps of many runs, concatenated: rows offsets[r]:offsets[r + 1] belong to run r.

    A row is a prediction with a known increment u, followed by an update with a measurement z. A NaN in
    the increment or the measurement skips that half of the step.

    Attributes:
        offsets: (runs + 1,).
        increment: unit vectors u (rows, d); the identity (1, 0, ...) if there is no control input.
        measurement: unit vectors z (rows, d).
    """

    offsets: Integers
    increment: Floats
    measurement: Floats


def make_steps(offsets: NDArray, increment: NDArray, measurement: NDArray) -> Steps:
    """Make steps from vectors, which are checked and scaled to exactly unit length.

    Args:
        offsets: (runs + 1,), the first row of each run.
        increment: known rotations (rows, d), unit vectors.
        measurement: unit vectors (rows, d), NaN if there is no measurement.

    Raises BadInput if a vector is neither a unit vector nor NaN, or if the arrays have different
    numbers of rows.
    """
    if not len(increment) == len(measurement) == offsets[-1]:
        raise BadInput(
            f"{len(increment)} increments and {len(measurement)} measurements for {offsets[-1]} steps; "
            "give one row of each for every step, NaN if there is no value"
        )
    return Steps(offsets, _unit_or_nan(increment, "increment"), _unit_or_nan(measurement, "measurement"))


def _unit_or_nan(x: NDArray, what: str) -> Floats:
    missing = np.isnan(x).all(axis=-1, keepdims=True)
    unit = require_unit(np.where(missing, np.eye(x.shape[-1])[0], x), what)
    return np.ascontiguousarray(np.where(missing, np.nan, unit))


class BinghamNoise(NamedTuple):
    """System noise w and measurement noise v, without batch axes; their modes are near the identity."""

    system: Bingham
    measurement: Bingham


class Gaussian(NamedTuple):
    """Gaussian states: mean (..., d) and covariance (..., d, d)."""

    mean: Floats
    covariance: Floats


class GaussianNoise(NamedTuple):
    """Covariances (d, d) of w - e_1 and v - e_1 about the identity e_1."""

    system: Floats
    measurement: Floats


@cache
def _over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    return compile_over_runs(run_once)


def run_bingham_filter(
    noise: BinghamNoise, state: Bingham, steps: Steps, rotations: Floats | None = None
) -> tuple[Bingham, Bingham]:
    """Run the recursive Bingham filter (algorithms 1 and 2).

    Args:
        noise: system and measurement noise.
        state: the distributions before the first row, batch axis (runs,).
        steps: increments and measurements of all runs.
        rotations: (rows, t, t), t = 1 or 3, overwritten if given: the covariances of small rotations
            about the modes, see `fuselog.replay.engine.vectors.tangent`.

    Returns:
        The state after the last row, and the estimates of all rows, batch axis (rows,). If a moment fit
        does not converge, the run is NaN from that row on; the other runs continue.
    """
    rows, d = steps.measurement.shape
    identity = np.eye(d)[0]
    state = Bingham(state.axes.copy(), state.concentrations.copy())
    estimates = Bingham(np.empty((rows, d, d)), np.empty((rows, d)))
    _over_runs(_bingham_run)(
        len(steps.offsets) - 1,
        steps,
        bingham.covariance(noise.system),
        bingham.parameter_matrix(bingham.likelihood(noise.measurement, identity)),
        state,
        estimates,
        _rotations(steps) if rotations is None else rotations,
    )
    return state, estimates


def _rotations(steps: Steps) -> Floats:
    rows, d = steps.measurement.shape
    return np.empty((rows, d - 1, d - 1))


def _bingham_run(
    run: int,
    steps: Steps,
    system: NDArray,
    inverse_noise: NDArray,
    state: Bingham,
    estimates: Bingham,
    rotations: NDArray,
) -> None:
    axes, z = state.axes[run], state.concentrations[run]
    d = len(z)
    moments, local = np.empty(d), np.empty((d, d))
    for row in range(steps.offsets[run], steps.offsets[run + 1]):
        if not math.isnan(steps.increment[row, 0]):
            turn_columns(axes, steps.increment[row])
            if not predict(axes, z, system):
                z[:] = np.nan
        if not math.isnan(steps.measurement[row, 0]):
            update(axes, z, inverse_noise, steps.measurement[row])
        if math.isnan(z[0]):
            # NaN propagates to all later rows of the run
            axes[:] = np.nan
        estimates.axes[row] = axes
        estimates.concentrations[row] = z
        local_moments(axes, z, moments, local)
        _store_rotations(local, rotations[row])


def run_kalman_filter(
    noise: GaussianNoise,
    state: Gaussian,
    steps: Steps,
    rotations: Floats | None = None,
    *,
    rotated: bool,
) -> tuple[Gaussian, Gaussian]:
    """Run the paper's modified Kalman filter on R^d, which may negate measurements (section 7).

    The filter normalizes the mean after every update.

    Args:
        noise: system and measurement noise; the paper adds it without rotation, regardless of the state.
        state: the Gaussians before the first row, batch axis (runs,).
        steps: increments and measurements of all runs.
        rotations: as for `run_bingham_filter`.
        rotated: whether the noise is rotated into the frame of the state, x (+) (w - e_1), before it is
            added.

    Returns:
        The state after the last row, and the estimates of all rows, batch axis (rows,). If the
        covariance of a run is no longer positive definite, the run is NaN from that row on.
    """
    rows, d = steps.measurement.shape
    state = Gaussian(state.mean.copy(), state.covariance.copy())
    estimates = Gaussian(np.empty((rows, d)), np.empty((rows, d, d)))
    noise = GaussianNoise(*map(np.ascontiguousarray, noise))
    local = _rotations(steps) if rotations is None else rotations
    _over_runs(_kalman_run)(len(steps.offsets) - 1, steps, noise, rotated, state, estimates, local)
    return state, estimates


def _kalman_run(
    run: int,
    steps: Steps,
    noise: GaussianNoise,
    rotated: bool,
    state: Gaussian,
    estimates: Gaussian,
    rotations: NDArray,
) -> None:
    x, p = state.mean[run], state.covariance[run]
    d = len(x)
    added, frame, innovation = np.empty((d, d)), np.empty(d), np.empty(d)
    for row in range(steps.offsets[run], steps.offsets[run + 1]):
        if not math.isnan(steps.increment[row, 0]):
            compose(x.copy(), steps.increment[row], x)
            turn_columns(p, steps.increment[row])
            turn_columns(p.T, steps.increment[row])
            _frame(x, rotated, frame)
            framed(noise.system, frame, added)
            for i in range(d):
                for j in range(d):
                    p[i, j] += added[i, j]
        if not math.isnan(steps.measurement[row, 0]):
            along = 0.0
            for i in range(d):
                along += x[i] * steps.measurement[row, i]
            # z and -z are the same axis: use the one closer to the state
            side = math.copysign(1.0, along)
            for i in range(d):
                innovation[i] = side * steps.measurement[row, i] - x[i]
            _frame(x, rotated, frame)
            framed(noise.measurement, frame, added)
            condition(x, p, innovation, added)
            length = _length(x)
            for i in range(d):
                x[i] /= length
        estimates.mean[row] = x
        estimates.covariance[row] = p
        inverse(x, frame)
        framed(p, frame, added)
        _store_rotations(added, rotations[row])


def _store_rotations(local: NDArray, covariance: NDArray) -> None:
    """Write the covariance (t, t) of small rotations, given the second moment about the identity.

    The vector part of a unit complex number is the angle; that of a quaternion is half the rotation
    vector.
    """
    t = len(covariance)
    for i in range(t):
        for j in range(t):
            covariance[i, j] = local[i + 1, j + 1] * (1.0 if t == 1 else 4.0)


def _length(x: NDArray) -> float:
    squared = 0.0
    for i in range(len(x)):
        squared += x[i] * x[i]
    return math.sqrt(squared)


def _frame(state: NDArray, rotated: bool, frame: NDArray) -> None:
    """Write the state, scaled to unit length, if `rotated`; otherwise write the identity."""
    length = _length(state)
    for i in range(len(state)):
        identity = 1.0 if i == 0 else 0.0
        frame[i] = state[i] / length if rotated else identity
