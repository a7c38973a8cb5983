"""Computes with estimates that are fused: inverses, transforms and searches, in place."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import cholesky, copy_gaussian

# what is left of a diagonal entry in the Cholesky factor of a matrix that counts as singular
SINGULAR = 1e-13
GOLDEN = 0.6180339887498949


class Estimate(NamedTuple):
    """Holds means (..., n), covariances (..., n, n), and the parts of these independent of all others.

    Only split CI looks at the parts.
    """

    mean: Floats
    covariance: Floats
    independent: Floats


class Fused(NamedTuple):
    """Holds where a fusion fills in its mean (n,), covariance (n, n) and weights (K,)."""

    mean: Floats
    covariance: Floats
    weights: Floats


def inverted(matrix: Floats, inverse: Floats) -> bool:
    """Fill the inverse of a positive definite matrix; False where it is not, or nearly singular.

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
    half = np.zeros((size, size))  # of the factor
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
    """Fill matrix @ vector.

    Args:
        matrix: (n, n).
        vector, image: (n,), not the same.
    """
    for row in range(len(vector)):
        image[row] = 0.0
        for k in range(len(vector)):
            image[row] += matrix[row, k] * vector[k]


def blend(share: float, left: Floats, rest: float, right: Floats, total: Floats) -> None:
    """Fill share * left + rest * right.

    Args:
        share, rest: what left and right are multiplied by.
        left, right, total: (n, n); the last, which is filled, may be one of the others.
    """
    for row in range(len(total)):
        for column in range(len(total)):
            total[row, column] = share * left[row, column] + rest * right[row, column]


def determinant(matrix: Floats) -> float:
    """Return the determinant of a matrix that is positive definite, else 0."""
    size = len(matrix)
    factor = np.zeros((size, size))
    if not cholesky(factor, matrix, size):
        return 0.0
    product = 1.0
    for row in range(size):
        product *= factor[row, row] ** 2
    return product


def put(given: Estimate, place: Estimate) -> None:
    """Copy an estimate; loops, since slices are very slow to compile."""
    copy_gaussian(given.mean, given.covariance, place.mean, place.covariance)
    place.independent[:, :] = given.independent


def one_of(estimates: Estimate, i: int) -> Estimate:
    """Return one of several estimates; changing it changes them."""
    return Estimate(estimates.mean[i], estimates.covariance[i], estimates.independent[i])


def steps_for(tolerance: float) -> int:
    """Count the steps of a golden section that leave a tenth of the root of the tolerance."""
    return 3 + int(np.ceil(np.log(0.1 * np.sqrt(tolerance)) / np.log(GOLDEN)))


def golden(step: int, steps: int, value: float, section: Floats) -> float:
    """Find where in (0, 1) a search for the least value looks next: golden section.

    The last of all steps is the middle of what is left. Written like this, the function that is searched
    is called in one place, and compiled once.

    Args:
        step, steps: which step, from 0, of how many.
        value: that at the last place; of no use at step 0.
        section: (7,), what the search remembers: both ends, both inner places, their values, and
            which of these `value` is.
    """
    if step == 0:
        section[0], section[1] = 1e-9, 1.0 - 1e-9
        section[2], section[3] = 1.0 - GOLDEN, GOLDEN
        section[6] = 2
        return section[2]
    section[2 + int(section[6])] = value  # 4: at the left place, 5: at the right one
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
