"""Comparison of errors with stated covariances: by component, error ellipses, dilution of precision.

NEES itself is `fuselog.replay.engine.vectors.covariances.normalized_error_squared`. Bar-Shalom, Li and
Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), 5.4.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.replay.engine import chi2

Array = NDArray[np.float64]
CONSISTENT = (
    0.999  # fraction of the logs of a consistent filter in which NIS or NEES is within its interval
)


def component_error_squared(error: Array, covariance: Array) -> Array:
    """Compute the normalised squared error of each component, (..., n)."""
    return error**2 / np.diagonal(covariance, axis1=-2, axis2=-1)


def ellipse_area(covariance: Array, probability: float = 0.95) -> Array:
    """Compute the area of the error ellipses of covariances (..., 2, 2) for a given probability.

    The area is zero if rounding makes the determinant of a singular covariance negative.
    """
    squared = np.maximum(np.linalg.det(covariance), 0.0)
    return np.pi * chi2.ppf(probability, 2) * np.sqrt(squared)


def ellipses(means: Array, covariances: Array, probability: float = 0.95, vertices: int = 24) -> Array:
    """Compute closed outlines (n, vertices + 1, 2) of Gaussians; NaN for invalid covariances.

    Args:
        means, covariances: (n, 2), (n, 2, 2).
        probability: probability of the Gaussian inside the outline.
        vertices: number of distinct points.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, vertices + 1)
    circle = np.sqrt(chi2.ppf(probability, 2)) * np.stack([np.cos(angle), np.sin(angle)])
    root = np.zeros_like(covariances)
    with np.errstate(
        invalid="ignore", divide="ignore"
    ):  # a Cholesky factorisation that does not raise if one matrix fails
        root[:, 0, 0] = np.sqrt(covariances[:, 0, 0])
        root[:, 1, 0] = covariances[:, 1, 0] / root[:, 0, 0]
        root[:, 1, 1] = np.sqrt(covariances[:, 1, 1] - root[:, 1, 0] ** 2)
        return means[:, None, :] + (root @ circle).transpose(0, 2, 1)


def dilution_of_precision(position_error_m: ArrayLike, range_m: ArrayLike, sigma_rad: Array) -> Array:
    """Compute the GDOP from position error, range and noise of both angles; Belfadel et al. 2014, (32).

    Args:
        position_error_m: (...,).
        range_m: (...,), the distance to the target.
        sigma_rad: (..., 2), standard deviations of azimuth and elevation.

    Returns:
        (...,).
    """
    return np.asarray(position_error_m) / (range_m * np.linalg.norm(sigma_rad, axis=-1))
