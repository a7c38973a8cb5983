"""Tests of covariances for definiteness, and errors normalised by covariances (NEES, NIS).

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), 5.4.
"""

import numpy as np
from numpy.typing import NDArray

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
    size = error.shape[-1]
    error = np.where(np.isinf(np.diagonal(covariance, axis1=-2, axis2=-1)), 0.0, error)
    # |L^-1 e|^2 with the Cholesky factors L of all P
    factor, whitened = _factors(covariance), np.empty_like(error)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for row in range(size):
            reached = np.sum(factor[..., row, :row] * whitened[..., :row], axis=-1)
            whitened[..., row] = (error[..., row] - reached) / factor[..., row, row]
        return np.sum(whitened**2, axis=-1) if size else np.full(whitened.shape[:-1], np.nan)


def log_likelihood(squared: Array, error: Array, covariance: Array) -> Array:
    """Compute the log-likelihood of Gaussian errors (..., n) from their NEES or NIS `squared` (...).

    A component that is NaN is missing. The result is NaN if the covariance of the others is not
    positive definite.

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
    """Compute lower Cholesky factors (..., n, n); NaN from the first pivot that is not positive on.

    A component of infinite variance is treated as independent of all others.
    """
    size = covariance.shape[-1]
    finite = ~np.isinf(np.diagonal(covariance, axis1=-2, axis2=-1))
    if not finite.all():
        both = finite[..., :, None] & finite[..., None, :]
        covariance = np.where(both, covariance, np.eye(size))
    factor = np.empty_like(covariance)
    with np.errstate(invalid="ignore", divide="ignore"):
        for row in range(size):
            for column in range(row + 1):
                entry = covariance[..., row, column]
                if column:
                    reached = factor[..., row, :column] * factor[..., column, :column]
                    entry = entry - np.sum(reached, axis=-1)
                if column < row:
                    factor[..., row, column] = entry / factor[..., column, column]
                else:
                    is_sound = entry > ROUNDING * covariance[..., row, row]
                    factor[..., row, row] = np.sqrt(np.where(is_sound, entry, np.nan))
    return factor
