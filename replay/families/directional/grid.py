"""Bayesian filters on a grid over the half circle and the torus, as a reference.

They discretize the domain instead of approximating the densities, so they show the best accuracy that
any filter with the same model can reach.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.families.directional.headings import turn_together
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.directional.bingham import BinghamNoise, Steps
from fuselog.replay.families.directional.distributions import bingham, wrapped_normal
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from fuselog.replay.families.directional.distributions.wrapped_normal_kernels import UNIFORM
from fuselog.replay.families.directional.torus import HeadingModel, Motion

if TYPE_CHECKING:
    from scipy import sparse

# A transition drops cells whose probability is below this fraction of its peak.
_NEGLIGIBLE = 1e-12


class GridEstimates(NamedTuple):
    """Results of a filter on a grid over the torus.

    Attributes:
        state: probabilities (runs, n, n) after the last row.
        mean: circular means (rows, 2) of the estimates of all rows.
        predicted: circular means (rows, 2) of the predictions, before the measurements.
        log_density: logarithms (rows,) of the predicted densities at the measurements.
    """

    state: Floats
    mean: Floats
    predicted: Floats
    log_density: Floats


def run_axis_grid_filter(noise: BinghamNoise, state: Floats, steps: Steps) -> tuple[Floats, Floats]:
    """Run the reference filter for `run_bingham_filter` with d = 2.

    Args:
        noise: system and measurement noise.
        state: probabilities (runs, cells) of the axes at the angles pi / cells * (0, 1, ...).
        steps: increments and measurements of all runs.

    Returns:
        The state after the last row, and the principal axes (rows, 2) of the estimates of all rows.
    """
    state = state.copy()
    cells = state.shape[1]
    angle = np.pi / cells * np.arange(cells)
    spectrum = np.fft.rfft(_axial_density(noise.system, angle))
    spectrum /= spectrum[0]
    increment, measurement = (
        np.arctan2(side[:, 1], side[:, 0])[:, None] for side in (steps.increment, steps.measurement)
    )
    axes = np.empty(steps.measurement.shape)
    for runs, rows in _in_step(steps.offsets):
        shift = np.exp(-2j * np.arange(len(spectrum)) * increment[rows])
        moved = np.fft.irfft(np.fft.rfft(state[runs]) * shift * spectrum, cells)
        prior = np.where(np.isnan(increment[rows]), state[runs], np.maximum(moved, 0.0))
        likelihood = _axial_density(noise.measurement, measurement[rows] - angle)
        posterior = np.where(np.isnan(measurement[rows]), prior, prior * likelihood)
        state[runs] = posterior / posterior.sum(axis=1, keepdims=True)
        double = np.angle((state[runs] * np.exp(2j * angle)).sum(axis=1))
        axes[rows] = np.stack([np.cos(0.5 * double), np.sin(0.5 * double)], axis=-1)
    return state, axes


def run_torus_grid_filter(
    model: HeadingModel,
    state: Floats,
    offsets: Integers,
    measurement: Floats,
    motion: Motion = turn_together,
) -> GridEstimates:
    """Run the reference filter for `run_toroidal_filter`.

    Args:
        model: motion and noise of the headings.
        state: probabilities (runs, n, n) at the angles of `torus_grid(n)`.
        offsets: (runs + 1,), the rows of each run.
        measurement: (rows, 2), rad; both angles are NaN if the row is only a prediction, and the second
            is NaN if it is not measured.
        motion: function that moves both angles by one step.
    """
    n = state.shape[1]
    grid = torus_grid(n).reshape(-1, 2)
    transition = _transition(model, grid, motion)
    probability = state.reshape(-1, n * n).copy()
    predicted, means = np.empty((2, *measurement.shape))
    log_density = np.empty(len(measurement))
    for runs, rows in _in_step(offsets):
        prior = np.ascontiguousarray(
            (transition @ probability[runs].T).T
        )  # rounding of the sums depends on the memory layout
        posterior = prior * _likelihood(model, measurement[rows], grid)
        total = posterior.sum(axis=1, keepdims=True)
        probability[runs] = posterior / total
        log_density[rows] = np.log(total[:, 0])
        predicted[rows], means[rows] = (
            np.angle((each[..., None] * np.exp(1j * grid)).sum(axis=1))
            for each in (prior, probability[runs])
        )
    return GridEstimates(probability.reshape(state.shape), means, predicted, log_density)


def torus_grid(n: int) -> Floats:
    """Return the angles (n, n, 2) of an n x n grid over [-pi, pi)^2."""
    angle = 2.0 * np.pi / n * np.arange(n) - np.pi
    return np.stack(np.meshgrid(angle, angle, indexing="ij"), axis=-1)


def _axial_density(distribution: bingham.Bingham, angle: NDArray) -> Floats:
    points = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.exp(bingham.log_density(distribution, points))


def _likelihood(model: HeadingModel, measured: Floats, grid: NDArray) -> Floats:
    """Compute densities (rows, cells) of measurements, or of the first angle if the second is NaN."""
    missing = np.isnan(measured)
    sigmas = np.where(missing, np.sqrt(UNIFORM), np.sqrt(np.diag(model.measurement)))
    correlation = model.measurement[0, 1] / np.sqrt(np.prod(np.diag(model.measurement)))
    covariance = sigmas[:, :, None] * sigmas[:, None, :] * np.eye(2)
    covariance[:, [0, 1], [1, 0]] = (correlation * sigmas.prod(axis=1) * ~missing.any(axis=1))[:, None]
    seen = WrappedNormal(np.nan_to_num(measured)[:, None], covariance[:, None])
    return wrapped_normal.density(seen, grid) * (2.0 * np.pi) ** missing.sum(axis=1, keepdims=True)


def _transition(model: HeadingModel, grid: NDArray, motion: Motion) -> "sparse.csr_array":
    """Compute the probability of each next cell (rows) given the previous cell (columns)."""
    from scipy import sparse  # slow to import

    moved = np.stack(motion(grid[:, 0], grid[:, 1], model.coupling_rad, *model.drift_rad), -1)
    reached = np.stack(
        [wrapped_normal.density(WrappedNormal(each, model.system), grid) for each in moved], axis=1
    )
    reached[reached < _NEGLIGIBLE * reached.max()] = 0.0
    return sparse.csr_array(reached / reached.sum(axis=0))


def _in_step(offsets: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Yield the runs with a first row, and these rows; then the runs with a second row, and so on."""
    counts = np.diff(offsets)
    for step in range(int(counts.max(initial=0))):
        runs = np.flatnonzero(counts > step)
        yield runs, offsets[runs] + step
