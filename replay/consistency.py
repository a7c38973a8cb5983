"""Errors against the covariance that was promised: NEES, ellipses, dilution of precision.

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), 5.4.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from recorders.errors import BadInput

Array = NDArray[np.float64]


def normalized_error_squared(error: Array, covariance: Array) -> Array:
    """NEES e' P^-1 e of errors (..., n) and covariances (..., n, n); leading axes broadcast.

    A component of infinite variance counts nothing; NaN where an error or a covariance is NaN. Raises
    BadInput where a covariance is singular.
    """
    n = error.shape[-1]
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    known = ~np.isinf(variance)
    inverse_sigma = np.where(known, 1.0 / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    both = known[..., :, None] & known[..., None, :]
    correlation = (
        inverse_sigma[..., :, None] * np.where(both, covariance, 0.0) * inverse_sigma[..., None, :]
    )
    correlation = np.where(both, correlation, np.eye(n))
    scaled = (inverse_sigma * error)[..., None]
    try:
        return (np.swapaxes(scaled, -1, -2) @ np.linalg.solve(correlation, scaled))[..., 0, 0]
    except np.linalg.LinAlgError as failure:
        raise BadInput("NEES: a covariance is singular; leave out the components it fixes") from failure


def component_error_squared(error: Array, covariance: Array) -> Array:
    """Each component's own normalized squared error, (..., n)."""
    return error**2 / np.diagonal(covariance, axis1=-2, axis2=-1)


def ellipse_area(covariance: Array, probability: float = 0.95) -> Array:
    """Area of the error ellipse of covariances (..., 2, 2) that holds this probability."""
    return np.pi * stats.chi2.ppf(probability, 2) * np.sqrt(np.linalg.det(covariance))


def dilution_of_precision(position_error_m: ArrayLike, range_m: ArrayLike, sigma_rad: Array) -> Array:
    """GDOP, position error by range and noise of both angles (..., 2); Belfadel et al. 2014, eq (32)."""
    return np.asarray(position_error_m) / (range_m * np.linalg.norm(sigma_rad, axis=-1))
