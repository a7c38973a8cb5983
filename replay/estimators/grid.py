"""Reference filters: Bayes' rule on a grid over the half circle and over the torus.

They approximate no density, only the domain, and show what any filter of the same model can reach.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from recorders.models.headings import turn_together
from replay.distributions import bingham, wrapped_normal
from replay.distributions.wrapped_normal import WrappedNormal
from replay.engine.arrays import Floats, Integers
from replay.estimators.bingham import BinghamNoise, Steps
from replay.estimators.torus import HeadingModel

# Cells that a transition reaches with less than this part of its peak are left out.
_NEGLIGIBLE = 1e-12


def run_axis_grid_filter(noise: BinghamNoise, state: Floats, steps: Steps) -> tuple[Floats, Floats]:
    """The reference for `run_bingham_filter` with d = 2.

    Args:
        noise: see there.
        state: probabilities (runs, cells) of the axes at the angles pi / cells * (0, 1, ...).
        steps: see there.

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
) -> tuple[Floats, Floats]:
    """The reference for `run_toroidal_filter`.

    Args:
        model: see there.
        state: probabilities (runs, n, n) at the angles of `torus_grid(n)`.
        offsets: (runs + 1,).
        measurement: (rows, 2), rad; NaN for a row that is only a prediction.

    Returns:
        The state after the last row, and the circular means (rows, 2) of the estimates of all rows.
    """
    n = state.shape[1]
    grid = torus_grid(n).reshape(-1, 2)
    transition = _transition(model, grid)
    probability = state.reshape(-1, n * n).copy()
    means = np.empty(measurement.shape)
    for runs, rows in _in_step(offsets):
        prior = (transition @ probability[runs].T).T
        seen = WrappedNormal(measurement[rows, None, :], model.measurement)
        missing = np.isnan(measurement[rows, :1])
        posterior = prior * np.where(missing, 1.0, wrapped_normal.density(seen, grid))
        posterior /= posterior.sum(axis=1, keepdims=True)
        probability[runs] = posterior
        means[rows] = np.angle((posterior[..., None] * np.exp(1j * grid)).sum(axis=1))
    return probability.reshape(state.shape), means


def torus_grid(n: int) -> Floats:
    """The angles (n, n, 2) of an n x n grid over [-pi, pi)^2."""
    angle = 2.0 * np.pi / n * np.arange(n) - np.pi
    return np.stack(np.meshgrid(angle, angle, indexing="ij"), axis=-1)


def _axial_density(distribution: bingham.Bingham, angle: NDArray) -> Floats:
    points = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.exp(bingham.log_density(distribution, points))


def _transition(model: HeadingModel, grid: NDArray) -> sparse.csr_array:
    """Probabilities of the next cell (rows) given the last one (columns)."""
    moved = np.stack(turn_together(grid[:, 0], grid[:, 1], model.coupling_rad, *model.drift_rad), -1)
    reached = np.stack(
        [wrapped_normal.density(WrappedNormal(each, model.system), grid) for each in moved], axis=1
    )
    reached[reached < _NEGLIGIBLE * reached.max()] = 0.0
    return sparse.csr_array(reached / reached.sum(axis=0))


def _in_step(offsets: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Row by row through all runs at once: the runs that have a next row, and these rows."""
    counts = np.diff(offsets)
    for step in range(int(counts.max(initial=0))):
        runs = np.flatnonzero(counts > step)
        yield runs, offsets[runs] + step
