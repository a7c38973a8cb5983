"""In-place linear algebra with small matrices for users' own estimators, written as scalar loops.

The functions are called from a compiled `follow` (see `fuselog.replay.engine.api.functions.recursive`)
and allocate no arrays: `follow` allocates working memory once, before the loop over the messages.
Covariances stay symmetric. A Kalman filter for x' = F x + w and z = H x + v is

    memory, product = update_memory(states, components), np.empty((states, states))
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        predict(mean, covariance, transition, process_noise, product)
        squared = update(mean, covariance, difference, rows, measurement_noise, memory)

Sarkka and Svensson, Bayesian Filtering and Smoothing, 2nd edition, 2023, chapters 4 and 6.
"""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import (
    Innovation,
    cholesky,
    downdate,
    drop_missing,
    kalman_step,
    no_innovation,
    propagate_covariance,
    whiten,
)

__all__ = ["UpdateMemory", "cholesky", "predict", "solve", "update", "update_memory"]


class UpdateMemory(NamedTuple):
    """Working memory of `update`, which overwrites the innovation."""

    innovation: Innovation
    step: Floats


def update_memory(states: int, components: int) -> UpdateMemory:
    """Allocate memory for updates of `states` states by at most `components` measured components."""
    return UpdateMemory(no_innovation(states, components), np.empty(states))


def solve(matrix: Floats, right: Floats, size: int) -> bool:
    """Solve A x = b in place, by the Cholesky factor of the leading block, which overwrites A.

    Args:
        matrix: A (n, n), symmetric positive definite in its first `size` rows and columns.
        right: b (n,).
        size: number of equations.

    Returns:
        Whether A was positive definite; otherwise `right` is not changed.
    """
    if not cholesky(matrix, matrix, size):
        return False
    for i in range(size):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]
    return True


def predict(
    mean: Floats, covariance: Floats, transition: Floats, noise: Floats, product: Floats
) -> None:
    """Predict in place: x becomes F x, and P becomes F P F' + Q.

    Args:
        mean: x (n,).
        covariance: P (n, n).
        transition: F (n, n).
        noise: Q (n, n).
        product: (n, n) working memory.
    """
    size = len(mean)
    for row in range(size):
        entry = 0.0
        for k in range(size):
            entry += transition[row, k] * mean[k]
        product[0, row] = entry
    mean[:] = product[0]
    propagate_covariance(covariance, transition, product)
    for row in range(size):
        for column in range(size):
            covariance[row, column] += noise[row, column]


def update(
    mean: Floats,
    covariance: Floats,
    difference: Floats,
    rows: Floats,
    noise: Floats,
    memory: UpdateMemory,
    gate: float = float("inf"),
) -> float:
    """Update in place to x + K v and P - K S K', with S = H P H' + R and K = P H' S^-1.

    Args:
        mean: x (n,).
        covariance: P (n, n).
        difference: v = z - h(x) (m,), NaN for missing components.
        rows: H (m, n), the derivative of the measurement with respect to the state.
        noise: R (m, m).
        memory: working memory from `update_memory`.
        gate: largest NIS; if it is exceeded, nothing is updated.

    Returns:
        The NIS v' S^-1 v; NaN if S is not positive definite, in which case nothing is updated.
    """
    innovation, step = memory.innovation, memory.step
    measured = len(difference)
    for i in range(measured):
        innovation.difference[i] = difference[i]
        for row in range(len(mean)):
            entry = 0.0
            for k in range(len(mean)):
                entry += covariance[row, k] * rows[i, k]
            innovation.cross_covariance[row, i] = entry
        for j in range(i + 1):
            entry = noise[i, j]
            for k in range(len(mean)):
                entry += rows[i, k] * innovation.cross_covariance[k, j]
            innovation.covariance[i, j] = innovation.covariance[j, i] = entry
    size = drop_missing(innovation)
    squared = whiten(innovation, size)[0]
    if not squared <= gate:
        return squared
    kalman_step(innovation, size, step)
    for row in range(len(mean)):
        mean[row] += step[row]
    downdate(covariance, innovation.cross_covariance, size)
    return squared
