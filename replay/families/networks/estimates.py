"""In-place operations on estimates to fuse: inverses, transformations and a golden-section search."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import cholesky, copy_gaussian

# a matrix is singular if its Cholesky factor keeps less than this share of a diagonal entry
SINGULAR = 1e-13
GOLDEN = 0.6180339887498949


class Estimate(NamedTuple):
    """Means (..., n), covariances (..., n, n), and the independent parts of the covariances.

    The independent parts are independent of all other errors; only split CI uses them.
    """

    mean: Floats
    covariance: Floats
    independent: Floats


class Fused(NamedTuple):
    """Output of a fusion: mean (n,), covariance (n, n) and weights (K,)."""

    mean: Floats
    covariance: Floats
    weights: Floats


def inverted(matrix: Floats, inverse: Floats) -> bool:
    """Compute the inverse of a positive definite matrix; return False if the matrix is nearly singular.

    Args:
        matrix, inverse: (n, n).
    """
    size = len(matrix)
    factor = np.zeros((size, size))
    if not cholesky(factor, matrix, size):
        return False
    for row in range(size):
        if not factor[row, row] ** 2 > SINGULAR * matrix[row, row]:
            return False
    half = np.zeros((size, size))  # inverse of the factor
    for column in range(size):
        half[column, column] = 1.0 / factor[column, column]
        for row in range(column + 1, size):
            entry = 0.0
            for k in range(column, row):
                entry -= factor[row, k] * half[k, column]
            half[row, column] = entry / factor[row, row]
    for row in range(size):
        for column in range(row + 1):
            entry = 0.0
            for k in range(row, size):
                entry += half[k, row] * half[k, column]
            inverse[row, column] = entry
            inverse[column, row] = entry
    return True


def transform(matrix: Floats, vector: Floats, image: Floats) -> None:
    """Compute matrix @ vector.

    Args:
        matrix: (n, n).
        vector, image: (n,), different arrays.
    """
    for row in range(len(vector)):
        image[row] = 0.0
        for k in range(len(vector)):
            image[row] += matrix[row, k] * vector[k]


def blend(share: float, left: Floats, rest: float, right: Floats, total: Floats) -> None:
    """Compute share * left + rest * right.

    Args:
        share, rest: factors of left and right.
        left, right, total: (n, n); `total` is overwritten and may be `left` or `right`.
    """
    for row in range(len(total)):
        for column in range(len(total)):
            total[row, column] = share * left[row, column] + rest * right[row, column]


def determinant(matrix: Floats) -> float:
    """Compute the determinant of a positive definite matrix; return 0 for any other matrix."""
    size = len(matrix)
    factor = np.zeros((size, size))
    if not cholesky(factor, matrix, size):
        return 0.0
    product = 1.0
    for row in range(size):
        product *= factor[row, row] ** 2
    return product


def put(given: Estimate, place: Estimate) -> None:
    """Copy an estimate element by element in loops, because slices take very long to compile."""
    copy_gaussian(given.mean, given.covariance, place.mean, place.covariance)
    place.independent[:, :] = given.independent


def one_of(estimates: Estimate, i: int) -> Estimate:
    """Return a view of one of several estimates."""
    return Estimate(estimates.mean[i], estimates.covariance[i], estimates.independent[i])


def steps_for(tolerance: float) -> int:
    """Return how many golden-section steps shrink the interval to a tenth of sqrt(tolerance)."""
    return 3 + int(np.ceil(np.log(0.1 * np.sqrt(tolerance)) / np.log(GOLDEN)))


def golden(step: int, steps: int, value: float, section: Floats) -> float:
    """Return the next position in (0, 1) of a golden-section search for a minimum.

    The last step returns the middle of the remaining interval. The caller evaluates the function to
    minimize, so that its call appears only once and is compiled once.

    Args:
        step, steps: index of this step, counted from 0, and the total number of steps.
        value: value at the previous position; ignored at step 0.
        section: (7,), state of the search: both ends, both inner positions, their values, and the index
            of the position of `value`.
    """
    if step == 0:
        section[0], section[1] = 1e-9, 1.0 - 1e-9
        section[2], section[3] = 1.0 - GOLDEN, GOLDEN
        section[6] = 2
        return section[2]
    section[2 + int(section[6])] = value  # 4: at the left position, 5: at the right one
    if step == 1:
        section[6] = 3
        return section[3]
    if step == steps - 1:
        return 0.5 * (section[0] + section[1])
    if section[4] < section[5]:
        section[1], section[3], section[5] = section[3], section[2], section[4]
        section[2] = section[1] - GOLDEN * (section[1] - section[0])
        section[6] = 2
    else:
        section[0], section[2], section[4] = section[2], section[3], section[5]
        section[3] = section[0] + GOLDEN * (section[1] - section[0])
        section[6] = 3
    return section[int(section[6])]
