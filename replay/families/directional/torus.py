"""Filters of two angles, x+ = motion(x) + w and z = x + v, modulo 2 pi.

These are the recursive toroidal filter that Kurz and Hanebeck announce in "Deterministic Sampling on the
Torus for Bivariate Circular Estimation", 2016, and the unscented Kalman filter with their UKF samples.
Both process an ensemble as ragged rows: rows offsets[r]:offsets[r + 1] belong to run r. A row is a
prediction, followed by an update with its measurement (2,). If the measurement is NaN, there is no
update; if only the second angle is NaN, the update uses only the first angle.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.headings import turn_together
from fuselog.recorders.models.planar import Component, wrap_angle
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.families.directional.distributions.gaussian_kernels import condition
from fuselog.replay.families.directional.distributions.wrapped_normal import (
    WrappedNormal,
    make_wrapped_normal,
    require_central_weight,
)
from fuselog.replay.families.directional.distributions.wrapped_normal_kernels import (
    TURN,
    UNIFORM,
    Mixture,
    blank_mixture,
    fit_product,
    fit_samples,
    five_samples,
)
from fuselog.replay.inference.run.loops import OnEvent, over_events

# A measurement with this variance (rad^2) changes a Gaussian by less than rounding error.
_VAGUE = 1e18


class HeadingModel(NamedTuple):
    """The motion of two headings and their noise.

    Attributes:
        coupling_rad: c in the motion, see `turn_together`.
        drift_rad: additional turns per step, (2,).
        system: covariance of w, (2, 2), rad^2.
        measurement: covariance of v, (2, 2), rad^2.
    """

    coupling_rad: float
    drift_rad: Floats
    system: Floats
    measurement: Floats


class HeadingRows(NamedTuple):
    """Measurements (n, 2) of all runs; rows offsets[r]:offsets[r + 1] belong to run r."""

    offsets: Integers
    measurement: Floats


class HeadingInputs(NamedTuple):
    """Inputs of a filter; `option` is the central weight, or whether angles are wrapped."""

    events: HeadingRows
    model: HeadingModel
    option: float | bool


# (two angles, coupling, drifts) -> the next two angles:
# `fuselog.recorders.families.directional.headings`.
Motion = Callable[..., tuple[Component, Component]]


def make_heading_model(
    coupling_rad: float, drift_rad: ArrayLike, system: ArrayLike, measurement: ArrayLike
) -> HeadingModel:
    """Make a heading model after checking its values.

    Args:
        coupling_rad: c in the motion, see `turn_together`.
        drift_rad: additional turns per step, (2,).
        system, measurement: covariances of w and v, (2, 2), rad^2.

    Raises BadInput if a covariance is not positive definite or a value is not finite.
    """
    if not (np.isfinite(coupling_rad) and np.isfinite(drift_rad).all() and np.shape(drift_rad) == (2,)):
        raise BadInput(
            "coupling and drift of a heading model must be finite; give two numbers for the drift"
        )
    covariances = [make_wrapped_normal(np.zeros(2), each).covariance for each in (system, measurement)]
    return HeadingModel(
        float(coupling_rad), np.array(drift_rad, float), *map(np.ascontiguousarray, covariances)
    )


def run_toroidal_filter(
    model: HeadingModel,
    state: WrappedNormal,
    offsets: Integers,
    measurement: Floats,
    *,
    motion: Motion = turn_together,
    central_weight: float = 0.2,
) -> tuple[WrappedNormal, WrappedNormal]:
    """Run the recursive toroidal filter.

    A prediction moves five samples, fits a wrapped normal to them by circular moments and r_c (or by
    mixed maximum likelihood if these allow no covariance), and adds the system noise. An update fits a
    wrapped normal to the exact product.

    Args:
        model: motion and noise of the headings.
        state: the distributions before the first row, batch axis (runs,).
        offsets: (runs + 1,), the rows of each run.
        measurement: (rows, 2), rad.
        motion: function that moves both angles by one step.
        central_weight: w5 of the five samples.

    Returns:
        The state after the last row, and the estimates of all rows, batch axis (rows,). If a run fails,
        it is NaN from that row on.
    """
    require_central_weight(central_weight)
    return _run(_toroidal_step, motion, model, state, offsets, measurement, central_weight)


def run_unscented_filter(
    model: HeadingModel,
    state: WrappedNormal,
    offsets: Integers,
    measurement: Floats,
    *,
    motion: Motion = turn_together,
    wrapped: bool,
) -> tuple[WrappedNormal, WrappedNormal]:
    """Run the unscented Kalman filter with the paper's five equally weighted samples.

    Args:
        model, state, offsets, measurement, motion: as for `run_toroidal_filter`.
        wrapped: whether the innovation is wrapped to [-pi, pi); if not, only the angles are reduced
            modulo 2 pi.

    Returns:
        The state and the estimates, as `run_toroidal_filter` returns them.
    """
    return _run(_unscented_step, motion, model, state, offsets, measurement, wrapped)


# Makes the function that processes a row, for a given motion.
MakeStep = Callable[[Motion], OnEvent]


def _run(
    step: MakeStep,
    motion: Motion,
    model: HeadingModel,
    state: WrappedNormal,
    offsets: Integers,
    measurement: Floats,
    option: float | bool,
) -> tuple[WrappedNormal, WrappedNormal]:
    if measurement.shape != (offsets[-1], 2):
        raise BadInput(
            f"heading measurements have shape {measurement.shape}; expected ({offsets[-1]}, 2)"
        )
    state = WrappedNormal(state.mean.copy(), state.covariance.copy())
    estimates = WrappedNormal(np.empty(measurement.shape), np.empty((*measurement.shape, 2)))
    rows = HeadingRows(offsets, np.ascontiguousarray(measurement))
    # a fit to samples is at most as wide as a uniform distribution
    most = UNIFORM + np.diagonal(model.system) + np.maximum(np.diagonal(model.measurement), UNIFORM)
    inputs, memory = HeadingInputs(rows, model, option), partial(blank_mixture, most)
    _over_runs(step, motion)(len(offsets) - 1, inputs, state, estimates, scratch=memory)
    return state, estimates


@cache
def _over_runs(step: MakeStep, motion: Motion) -> OverRuns:
    """Compile the loop of a filter; the function that `step` makes processes one row."""
    loop = over_events(step(motion), _write, fails=False)
    return compile_over_runs(loop, title="a filter of headings")


def _write(
    run: int, row: int, _: HeadingInputs, state: WrappedNormal, estimates: WrappedNormal, __: Mixture
) -> int:
    estimates.mean[row] = state.mean[run]
    estimates.covariance[row] = state.covariance[run]
    return ALL_WELL


def _toroidal_step(motion: Motion) -> OnEvent:
    def step(
        run: int, row: int, inputs: HeadingInputs, state: WrappedNormal, _: WrappedNormal, work: Mixture
    ) -> int:
        mean, covariance = state.mean[run], state.covariance[run]
        model, z = inputs.model, inputs.events.measurement[row]
        x, weights = np.empty((5, 2)), np.empty(5)
        five_samples(mean, covariance, inputs.option, x, weights)
        _move(motion, model, x)
        _store(fit_samples(x, weights), mean, covariance)
        for i in range(2):
            for j in range(2):
                covariance[i, j] += model.system[i, j]
        if not covariance[0, 0] * covariance[1, 1] > covariance[0, 1] ** 2:
            # not a distribution: NaN propagates to all later rows of the run
            mean[:], covariance[:] = np.nan, np.nan
        elif not math.isnan(z[0]):
            measured, noise = np.empty(2), np.empty((2, 2))
            _take(z, model.measurement, UNIFORM, measured, noise)
            _store(fit_product(mean, covariance, measured, noise, work), mean, covariance)
        return ALL_WELL

    return step


def _take(z: NDArray, noise: NDArray, vague: float, measured: NDArray, covariance: NDArray) -> None:
    """Write a measurement and its covariance; a missing angle gets a negligible weight."""
    is_whole = not math.isnan(z[1])
    for i in range(2):
        measured[i] = z[i] if is_whole or i == 0 else 0.0
        for j in range(2):
            covariance[i, j] = noise[i, j] if is_whole or i + j == 0 else 0.0
    if not is_whole:
        covariance[1, 1] = vague


def _move(motion: Motion, model: HeadingModel, x: NDArray) -> None:
    for n in range(len(x)):
        x[n, 0], x[n, 1] = motion(
            x[n, 0], x[n, 1], model.coupling_rad, model.drift_rad[0], model.drift_rad[1]
        )


def _store(
    parameters: tuple[float, float, float, float, float], mean: NDArray, covariance: NDArray
) -> None:
    mean[0], mean[1], covariance[0, 0], covariance[0, 1], covariance[1, 1] = parameters
    covariance[1, 0] = covariance[0, 1]


def _unscented_step(motion: Motion) -> OnEvent:
    def step(
        run: int, row: int, inputs: HeadingInputs, state: WrappedNormal, _: WrappedNormal, __: Mixture
    ) -> int:
        mean, covariance, x = state.mean[run], state.covariance[run], np.empty((5, 2))
        model, wrapped, z = inputs.model, inputs.option, inputs.events.measurement[row]
        _fill_sigma_points(mean, covariance, x)
        _move(motion, model, x)
        for k in range(2):
            mean[k] = 0.0
            for n in range(len(x)):
                x[n, k] = x[n, k] if wrapped else x[n, k] % TURN
            for n in range(len(x)):
                mean[k] += x[n, k] / len(x)
        for i in range(2):
            for j in range(i + 1):
                spread = 0.0
                for n in range(len(x)):
                    spread += (x[n, i] - mean[i]) * (x[n, j] - mean[j])
                covariance[i, j] = covariance[j, i] = spread / len(x) + model.system[i, j]
        if not math.isnan(z[0]):
            measured, noise, innovation = np.empty(2), np.empty((2, 2)), np.empty(2)
            _take(z, model.measurement, _VAGUE, measured, noise)
            for k in range(2):
                innovation[k] = wrap_angle(measured[k] - mean[k]) if wrapped else measured[k] - mean[k]
            condition(mean, covariance, innovation, noise)
        for k in range(2):
            mean[k] = wrap_angle(mean[k]) if wrapped else mean[k] % TURN
        return ALL_WELL

    return step


def _fill_sigma_points(mean: NDArray, covariance: NDArray, x: NDArray) -> None:
    """Write the mean and the mean ± sqrt(5 / 2) times the columns of the Cholesky factor."""
    first = math.sqrt(2.5 * covariance[0, 0])
    below = 2.5 * covariance[0, 1] / first
    second = math.sqrt(2.5 * covariance[1, 1] - below * below)
    for n, (along, across) in enumerate(((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))):
        x[n, 0] = mean[0] + along * first
        x[n, 1] = mean[1] + along * below + across * second
