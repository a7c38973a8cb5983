"""Kernels of Gaussians: small positive definite systems and measurements of the state itself."""

import math

from numpy.typing import NDArray


def solve_in_place(matrix: NDArray, right: NDArray) -> None:
    """Solve matrix x = right with the Cholesky factor of the leading (n, n) block.

    The result is NaN if the block is not positive definite.

    Args:
        matrix: the matrix, with n or more rows and columns; the factor overwrites its leading block.
        right: (n, m), overwritten by the solution.
    """
    n, columns = right.shape
    for i in range(n):
        for j in range(i):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]
            matrix[i, i] -= matrix[i, j] ** 2
        matrix[i, i] = math.sqrt(matrix[i, i])
    for column in range(columns):
        for i in range(n):
            for j in range(i):
                right[i, column] -= matrix[i, j] * right[j, column]
            right[i, column] /= matrix[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                right[i, column] -= matrix[k, i] * right[k, column]
            right[i, column] /= matrix[i, i]


def condition(mean: NDArray, covariance: NDArray, innovation: NDArray, noise: NDArray) -> None:
    """Apply the Kalman update in place for a measurement of the state itself, z = x + v.

    Args:
        mean: (d,).
        covariance: (d, d).
        innovation: z minus the mean, (d,).
        noise: the covariance of v, (d, d).
    """
    d = len(mean)
    innovation_covariance, gain = covariance.copy(), covariance.copy()
    for i in range(d):
        for j in range(d):
            innovation_covariance[i, j] += noise[i, j]
    solve_in_place(innovation_covariance, gain)
    for i in range(d):
        for j in range(d):
            mean[i] += gain[j, i] * innovation[j]
    # gain holds S^-1 P, the transpose of the gain: P - P S^-1 P
    prior = covariance.copy()
    for i in range(d):
        for j in range(d):
            for k in range(d):
                covariance[i, j] -= prior[i, k] * gain[k, j]
