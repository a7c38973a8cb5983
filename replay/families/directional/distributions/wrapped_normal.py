"""Bivariate wrapped normals on the torus and their deterministic samples.

Kurz and Hanebeck, "Deterministic Sampling on the Torus for Bivariate Circular Estimation", 2016. Angles
are in rad. Batch axes come first in every function. The functions are accurate for variances from 1e-6
up to those at which the density is uniform.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.families.directional.distributions import wrapped_normal_kernels as kernels
from fuselog.replay.families.directional.distributions.batches import flatten
from fuselog.replay.families.directional.distributions.wrapped_normal_kernels import Mixture

_product_mixture = compiled(kernels.product_mixture)


class WrappedNormal(NamedTuple):
    """Wrapped normals: mean (..., 2) in [-pi, pi), covariance (..., 2, 2) of the unwrapped angles."""

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]


class CircularMoments(NamedTuple):
    """Circular moments; the first trigonometric moments are exp(i mean - variance / 2).

    Attributes:
        mean: circular means (..., 2).
        variance: circular variances -2 ln|m_1| (..., 2).
        correlation: Jammalamadaka and Sarma's r_c (...).
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    correlation: NDArray[np.float64]


class Samples(NamedTuple):
    """Weighted samples: positions (..., n, 2), weights (..., n) with sum 1."""

    positions: NDArray[np.float64]
    weights: NDArray[np.float64]


def make_wrapped_normal(mean: ArrayLike, covariance: ArrayLike) -> WrappedNormal:
    """Make a wrapped normal from a checked mean and covariance.

    Args:
        mean: (..., 2), in rad; it is wrapped.
        covariance: (..., 2, 2), in rad^2.

    Raises BadInput if a value is not finite or the covariance is not symmetric and positive definite.
    """
    mean, covariance = np.asarray(mean, float), np.asarray(covariance, float)
    if mean.shape[-1:] != (2,) or covariance.shape[-2:] != (2, 2):
        raise BadInput(
            f"this wrapped normal has a mean of shape {mean.shape} and a covariance of shape "
            f"{covariance.shape}; expected (..., 2) and (..., 2, 2)"
        )
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise BadInput("the mean and covariance of a wrapped normal must be finite")
    if not np.allclose(
        covariance[..., 0, 1], covariance[..., 1, 0], rtol=1e-9, atol=0.0
    ) or not _is_definite(covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]):
        raise BadInput("the covariance of a wrapped normal must be symmetric and positive definite")
    return WrappedNormal(wrap_angle(mean), covariance)


def density(distribution: WrappedNormal, x: ArrayLike) -> NDArray[np.float64]:
    """Compute the density (...) at angles x (..., 2).

    Args:
        distribution: wrapped normals with batch axes (...).
        x: (..., 2), in rad.
    """
    deviation = np.asarray(x, float) - distribution.mean
    batch = np.broadcast_shapes(deviation.shape[:-1], distribution.covariance.shape[:-2])
    covariance = flatten(distribution.covariance, batch, 2, 2)
    return kernels.density_each(flatten(deviation, batch, 2), covariance).reshape(batch)


def circular_moments(distribution: WrappedNormal) -> CircularMoments:
    """Compute, in closed form, the circular moments of the distribution."""
    c = distribution.covariance
    correlation = kernels.circular_correlation(c[..., 0, 0], c[..., 0, 1], c[..., 1, 1])
    return CircularMoments(distribution.mean, np.diagonal(c, axis1=-2, axis2=-1), correlation)


def sample_moments(samples: Samples) -> CircularMoments:
    """Compute the circular moments of weighted samples."""
    moments = _of_samples(kernels.circular_moments_each, samples)
    return CircularMoments(moments[..., :2], moments[..., 2:4], moments[..., 4])


def five_samples(moments: CircularMoments, central_weight: float = 0.2) -> Samples:
    """Make five samples with exactly these circular moments: algorithm 1.

    Args:
        moments: moments of any distribution on the torus.
        central_weight: w5, 0 to 1/2. With 0.2, as in the paper, weights are equal if there is no
            correlation; in the experiment of figure 3, 0.45 preserves the covariance better and the mean
            less well.

    Raises BadInput if no real positions exist for w5, or if |r_c| > 1.
    """
    require_central_weight(central_weight)
    if not np.all(np.abs(moments.correlation) <= 1.0):
        raise BadInput("a circular correlation must be in [-1, 1]; check the moments")
    a, b, w1, w3 = kernels.diracs(
        moments.variance[..., 0], moments.variance[..., 1], moments.correlation, central_weight
    )
    offsets = np.stack([a, b], axis=-1)[..., None, :] * kernels.DIRAC_SIGNS
    weights = np.stack([w1, w1, w3, w3, np.full_like(w1, central_weight)], -1)
    return Samples(wrap_angle(moments.mean[..., None, :] + offsets), weights)


def require_central_weight(central_weight: float) -> None:
    """Raise BadInput unless w5 is in [0, 1/2], the range with real positions for every m_1."""
    if not 0.0 <= central_weight <= 0.5:
        raise BadInput(f"central weight {central_weight:g} is not in [0, 0.5]; the paper uses 0.2")


def fit_moments(moments: CircularMoments) -> WrappedNormal:
    """Return the wrapped normal with these circular moments.

    Raises BadInput if a variance is not positive and finite, or if no positive definite covariance has
    this r_c; `fit_mixed_mle` always finds a covariance.
    """
    c11, c22 = moments.variance[..., 0], moments.variance[..., 1]
    if not np.all((moments.variance > 0.0) & (moments.variance <= kernels.UNIFORM)):
        raise BadInput(
            "a circular variance -2 ln|m| is not in (0, 80]: the length |m| of a first moment must be "
            "above 0 and below 1; check the moments"
        )
    c12 = kernels.covariance_of(moments.correlation, c11, c22)
    if not _is_definite(c11, c12, c22):
        raise BadInput(
            "no positive definite covariance has this circular correlation; use fit_mixed_mle"
        )
    return _assemble(np.stack([moments.mean[..., 0], moments.mean[..., 1], c11, c12, c22], axis=-1))


def fit_mixed_mle(samples: Samples) -> WrappedNormal:
    """Fit means and variances by moments, C_12 by maximum likelihood (Kurz and Hanebeck, CDC 2015).

    This fit is not the inverse of `five_samples`: for five samples of sigma (0.8, 1.3) and correlation
    0.5, it returns a correlation of 0.461.
    """
    return _assemble(_of_samples(kernels.fit_mixed_mle_each, samples))


def product_mixture(first: WrappedNormal, second: WrappedNormal) -> Mixture:
    """Compute the exact normalized product of two densities without batch axes."""
    made = kernels.blank_mixture(np.diagonal(first.covariance + second.covariance))
    count = _product_mixture(*first, *second, made)
    return Mixture(made.mean[:count], made.weights[:count], made.covariance)


def product(first: WrappedNormal, second: WrappedNormal) -> WrappedNormal:
    """Return the wrapped normal with the circular moments and r_c of the product of two densities."""
    batch = np.broadcast_shapes(first.mean.shape[:-1], second.mean.shape[:-1])
    parameters = kernels.fit_product_each(
        flatten(first.mean, batch, 2),
        flatten(first.covariance, batch, 2, 2),
        flatten(second.mean, batch, 2),
        flatten(second.covariance, batch, 2, 2),
    )
    return _assemble(parameters.reshape(*batch, 5))


def sample(
    distribution: WrappedNormal, count: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Draw `count` samples (..., count, 2) from every distribution, in [-pi, pi)."""
    root = np.linalg.cholesky(distribution.covariance)
    normal = generator.standard_normal((*distribution.mean.shape[:-1], count, 2))
    return wrap_angle(distribution.mean[..., None, :] + normal @ np.swapaxes(root, -1, -2))


def _of_samples(kernel: Callable[[NDArray, NDArray], NDArray], samples: Samples) -> NDArray[np.float64]:
    """Return the result (..., 5) of `kernel` for every sample set."""
    n = samples.positions.shape[-2]
    batch = np.broadcast_shapes(samples.positions.shape[:-2], samples.weights.shape[:-1])
    fitted = kernel(flatten(samples.positions, batch, n, 2), flatten(samples.weights, batch, n))
    return fitted.reshape(*batch, 5)


def _assemble(parameters: NDArray) -> WrappedNormal:
    """Return the distributions with parameters m1, m2, c11, c12, c22 on the last axis."""
    return WrappedNormal(parameters[..., :2], parameters[..., [[2, 3], [3, 4]]])


def _is_definite(c11: NDArray, c12: NDArray, c22: NDArray) -> bool:
    return bool(np.all((c11 > 0.0) & (c12 * c12 < c11 * c22)))
