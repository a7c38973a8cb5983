"""Tests of covariances for definiteness, and errors normalised by covariances (NEES, NIS).

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), 5.4.
"""

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled

Array = NDArray[np.float64]

# Smaller fractions of a variance are rounding errors.
ROUNDING = 1e-14


def normalized_error_squared(error: Array, covariance: Array) -> Array:
    """Compute NEES or NIS e' P^-1 e of errors (..., n); leading axes broadcast.

    A component of infinite variance is ignored. The result is NaN if there are no components, if an
    error or a covariance is NaN, or if a covariance is not positive definite.

    Args:
        error: (..., n), in the units of the components.
        covariance: (..., n, n).

    >>> errors = np.array([[1.0, 2.0], [0.0, 1.0]])
    >>> normalized_error_squared(errors, np.diag([1.0, 4.0])).tolist()
    [2.0, 0.25]
    """
    return errors_squared(error, covariance, 0)[0]


def errors_squared(error: Array, covariance: Array, leading: int) -> tuple[Array, Array]:
    """Compute the NEES or NIS of all components and of the first few; see `normalized_error_squared`.

    Args:
        error: (..., n), in the units of the components.
        covariance: (..., n, n).
        leading: number of first components.

    Returns both (...); the second is NaN without leading components.
    """
    size = error.shape[-1]
    shape = np.broadcast_shapes(error.shape[:-1], covariance.shape[:-2])
    found = np.full((2, *shape), np.nan)
    if size and found.size:
        errors = np.broadcast_to(error, (*shape, size)).reshape(-1, size)
        covariances = np.broadcast_to(covariance, (*shape, size, size)).reshape(-1, size, size)
        errors, covariances = (np.ascontiguousarray(each, float) for each in (errors, covariances))
        work = np.empty((size, size)), np.empty(size)
        _fill_squares(errors, covariances, leading, *work, *(each.reshape(-1) for each in found))
    return found[0][()], found[1][()]


def fill_squares(
    errors: Array,
    covariances: Array,
    leading: int,
    factor: Array,
    whitened: Array,
    squares: Array,
    leading_squares: Array,
) -> None:
    """Compute |L^-1 e|^2 of errors (n, d) with the Cholesky factors L of covariances (n, d, d).

    Args:
        errors: (n, d).
        covariances: (n, d, d).
        leading: number of components of the second result; their factor is a part of L.
        factor: (d, d), work space.
        whitened: (d,), work space.
        squares: (n,), filled.
        leading_squares: (n,), filled if there are leading components.
    """
    size = covariances.shape[1]
    for each in range(len(errors)):
        factorise(covariances[each], factor)
        for row in range(size):
            error = 0.0 if np.isinf(covariances[each, row, row]) else errors[each, row]
            whitened[row] = (error - dot(factor[row], whitened, row)) / factor[row, row]
        squares[each] = dot(whitened, whitened, size)
        if leading:
            leading_squares[each] = dot(whitened, whitened, leading)


def log_likelihood(squared: Array, error: Array, covariance: Array) -> Array:
    """Compute the log-likelihood of Gaussian errors (..., n) from their NEES or NIS `squared` (...).

    A component that is NaN is missing. The result is NaN if the covariance of the remaining components
    is not positive definite.

    Args:
        squared: (...).
        error: (..., n).
        covariance: (..., n, n).

    >>> spread = np.array([[4.0, np.nan], [np.nan, np.nan]])
    >>> round(float(log_likelihood(np.array(1.0), np.array([2.0, np.nan]), spread)), 6)
    -2.112086
    """
    known = np.isfinite(error)
    both = known[..., :, None] & known[..., None, :]
    pivots = np.diagonal(
        _factors(np.where(both, covariance, np.eye(error.shape[-1]))), axis1=-2, axis2=-1
    )
    determinant = 2.0 * np.sum(np.log(pivots), axis=-1)
    logarithm: Array = -0.5 * (squared + determinant + known.sum(axis=-1) * np.log(2.0 * np.pi))
    return logarithm


def is_positive_definite(covariance: Array) -> NDArray[np.bool_]:
    """Test whether covariances (..., n, n) are positive definite; see `normalized_error_squared`."""
    pivots = np.diagonal(_factors(covariance), axis1=-2, axis2=-1)
    are_definite: NDArray[np.bool_] = np.isfinite(pivots).all(axis=-1) & (pivots.shape[-1] > 0)
    return are_definite


def _factors(covariance: Array) -> Array:
    """Compute lower Cholesky factors (..., n, n), which are NaN from the first nonpositive pivot on.

    A component of infinite variance is treated as independent of all others.
    """
    factors = np.empty_like(covariance, float, "C")
    if factors.size:
        shape = -1, *covariance.shape[-2:]
        covariances = np.ascontiguousarray(covariance.reshape(shape), float)
        _fill_factors(covariances, factors.reshape(shape))
    return factors


def fill_factors(covariances: Array, factors: Array) -> None:
    """Compute the factors (n, d, d) of covariances (n, d, d); see `factorise`."""
    for each in range(len(factors)):
        factorise(covariances[each], factors[each])


def factorise(covariance: Array, factor: Array) -> None:
    """Compute the lower triangle of a Cholesky factor (d, d); see `_factors`."""
    for row in range(factor.shape[1]):
        for column in range(row + 1):
            entry = covariance[row, column]
            if np.isinf(covariance[row, row]) or np.isinf(covariance[column, column]):
                entry = 1.0 if row == column else 0.0
            explained = 0.0
            for place in range(column):
                explained += factor[row, place] * factor[column, place]
            rest = entry - explained
            if column < row:
                factor[row, column] = rest / factor[column, column]
            elif rest > ROUNDING * entry:
                factor[row, row] = np.sqrt(rest)
            else:
                factor[row, row] = np.nan


def dot(left: Array, right: Array, size: int) -> float:
    """Compute the product of the first elements of two vectors, in the order in which NumPy sums."""
    whole = size - size % 8 if size >= 8 else 0
    total = 0.0
    if whole:
        lane = np.zeros(8)
        for place in range(whole):
            lane[place % 8] += left[place] * right[place]
        total = ((lane[0] + lane[1]) + (lane[2] + lane[3])) + ((lane[4] + lane[5]) + (lane[6] + lane[7]))
    for place in range(whole, size):
        total += left[place] * right[place]
    return total


_fill_squares = compiled(fill_squares, for_sizes=True)
_fill_factors = compiled(fill_factors, for_sizes=True)
