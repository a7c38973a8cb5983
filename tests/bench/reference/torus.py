"""Frozen reference: the filters of two headings that turn together, specialised by hand.

As they were before filters were made from models (issue 13), to be timed against and for nothing else.
How wrapped normal distributions are fitted is not the filter's, and is taken from
`fuselog.replay.families.directional.distributions`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.through_numba import numba_over_runs
from fuselog.replay.families.directional.distributions.gaussian_kernels import condition
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from fuselog.replay.families.directional.distributions.wrapped_normal_kernels import (
    TURN,
    blank_mixture,
    fit_product,
    fit_samples,
    five_samples,
)
from tests.bench.reference.gaussian import wrap_angle


def turn_together(
    x1: float, x2: float, coupling: float, drift1: float, drift2: float
) -> tuple[float, float]:
    """The next headings (rad, not wrapped) without noise."""
    return x1 + coupling * np.cos(x2) + drift1, x2 + coupling * np.sin(x1) + drift2


class HeadingModel(NamedTuple):
    """The system and its noise.

    Attributes:
        coupling_rad: c in `turn_together`.
        drift_rad: what is added in every step, (2,).
        system: covariance of w, (2, 2), rad^2.
        measurement: covariance of v, (2, 2), rad^2.
    """

    coupling_rad: float
    drift_rad: NDArray[np.float64]
    system: NDArray[np.float64]
    measurement: NDArray[np.float64]


@cache
def compiled(step: Callable[..., None]) -> Callable[..., None]:
    """The compiled loop of a filter: `step` at every row, its state written down."""

    def run_once(
        run: int,
        model: HeadingModel,
        option: float | bool,
        offsets: NDArray[np.int64],
        measurement: NDArray[np.float64],
        state: WrappedNormal,
        estimates: WrappedNormal,
    ) -> None:
        for row in range(offsets[run], offsets[run + 1]):
            step(model, option, measurement[row], state, run)
            estimates.mean[row] = state.mean[run]
            estimates.covariance[row] = state.covariance[run]

    return numba_over_runs(run_once)


def toroidal_step(
    model: HeadingModel, central_weight: float, z: NDArray, state: WrappedNormal, run: int
) -> None:
    mean, covariance = state.mean[run], state.covariance[run]
    x, weights = np.empty((5, 2)), np.empty(5)
    five_samples(mean, covariance, central_weight, x, weights)
    _move(model, x)
    _store(fit_samples(x, weights), mean, covariance)
    covariance += model.system
    if not covariance[0, 0] * covariance[1, 1] > covariance[0, 1] ** 2:
        # no distribution: NaN stays, all later rows of the run are NaN as well
        mean[:], covariance[:] = np.nan, np.nan
    elif not math.isnan(z[0]):
        mixture = blank_mixture(np.diag(covariance + model.measurement))
        _store(fit_product(mean, covariance, z, model.measurement, mixture), mean, covariance)


def _move(model: HeadingModel, x: NDArray) -> None:
    for n in range(len(x)):
        x[n, 0], x[n, 1] = turn_together(
            x[n, 0], x[n, 1], model.coupling_rad, model.drift_rad[0], model.drift_rad[1]
        )


def _store(
    parameters: tuple[float, float, float, float, float], mean: NDArray, covariance: NDArray
) -> None:
    mean[0], mean[1], covariance[0, 0], covariance[0, 1], covariance[1, 1] = parameters
    covariance[1, 0] = covariance[0, 1]


def unscented_step(
    model: HeadingModel, wrapped: bool, z: NDArray, state: WrappedNormal, run: int
) -> None:
    mean, covariance = state.mean[run], state.covariance[run]
    x = _sigma_points(mean, covariance)
    _move(model, x)
    if not wrapped:
        x %= TURN
    for k in range(2):
        mean[k] = x[:, k].mean()
    for i in range(2):
        for j in range(2):
            spread = ((x[:, i] - mean[i]) * (x[:, j] - mean[j])).mean()
            covariance[i, j] = spread + model.system[i, j]
    if not math.isnan(z[0]):
        innovation = z - mean
        condition(mean, covariance, wrap_angle(innovation) if wrapped else innovation, model.measurement)
    for k in range(2):
        mean[k] = wrap_angle(mean[k]) if wrapped else mean[k] % TURN


def _sigma_points(mean: NDArray, covariance: NDArray) -> NDArray:
    """The mean, and the mean plus and minus sqrt(5 / 2) times the columns of the Cholesky factor."""
    first = math.sqrt(2.5 * covariance[0, 0])
    below = 2.5 * covariance[0, 1] / first
    second = math.sqrt(2.5 * covariance[1, 1] - below * below)
    x = np.empty((5, 2))
    for n, (along, across) in enumerate(((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))):
        x[n, 0] = mean[0] + along * first
        x[n, 1] = mean[1] + along * below + across * second
    return x
