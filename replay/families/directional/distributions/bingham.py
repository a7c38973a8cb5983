"""The Bingham distribution, f(x) = exp(x^T M Z M^T x) / F, of axes and orientations.

Kurz, Gilitschenski, Julier, Hanebeck, "Recursive Bingham Filter for Directional Estimation Involving 180
Degree Symmetry", JAIF 9(2), 2014. Every function takes batch axes first. The kernels in
`bingham_kernels` are exact for concentrations from 0 to beyond 1e6; the paper uses a saddlepoint
approximation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.noise import sample_bingham
from fuselog.recorders.models.orientation import conjugate, left_matrix, require_unit, right_matrix
from fuselog.replay.families.directional.distributions import bingham_kernels as kernels
from fuselog.replay.families.directional.distributions.batches import flatten


class Bingham(NamedTuple):
    """Bingham distributions with any batch axes.

    Attributes:
        axes: M (..., d, d), orthogonal, principal axes in columns, the mode last.
        concentrations: the diagonal of Z (..., d), ascending, the last one 0.
    """

    axes: NDArray[np.float64]
    concentrations: NDArray[np.float64]

    @property
    def mode(self) -> NDArray[np.float64]:
        """Return the most probable axis (..., d); its negative is equally probable."""
        return self.axes[..., -1]


def make_bingham(axes: ArrayLike, concentrations: ArrayLike) -> Bingham:
    """Make a distribution from axes and concentrations in any order and with any offset.

    Raises BadInput if d is not 2 or 4, a value is not finite, or the axes are not orthonormal.

    Args:
        axes: (..., d, d), orthonormal, as columns.
        concentrations: (..., d), along these axes; only their differences matter.
    """
    axes, z = np.asarray(axes, float), np.asarray(concentrations, float)
    d = z.shape[-1] if z.ndim else 0
    if d not in (2, 4) or axes.shape[-2:] != (d, d):
        raise BadInput(
            f"Bingham axes have shape {axes.shape} and concentrations {z.shape}; expected (..., d, d) "
            "and (..., d) with d = 2 or 4"
        )
    if not np.isfinite(z).all():
        raise BadInput("Bingham concentrations must be finite; use 0 for a uniform distribution")
    if not np.allclose(axes @ np.swapaxes(axes, -1, -2), np.eye(d), rtol=0.0, atol=1e-9):
        raise BadInput("Bingham axes must be an orthogonal matrix; give orthonormal columns")
    shape = np.broadcast_shapes(axes.shape[:-1], z.shape)
    order = np.argsort(np.broadcast_to(z, shape), axis=-1, kind="stable")
    z = np.take_along_axis(np.broadcast_to(z, shape), order, -1)
    axes = np.take_along_axis(np.broadcast_to(axes, (*shape, d)), order[..., None, :], -1)
    return Bingham(axes, z - z[..., -1:])


def around(mode: ArrayLike, concentrations: ArrayLike) -> Bingham:
    """Make distributions about given modes, with concentrations along mode (+) e_2, ..., e_d.

    With a concentration of -2 / sigma_rad^2, small errors of an orientation about its axis i have the
    standard deviation sigma_rad, because a quaternion contains half angles.

    Args:
        mode: (..., d), unit vectors.
        concentrations: (..., d - 1), at most 0.
    """
    mode = require_unit(mode, "mode of a Bingham distribution")
    z = np.asarray(concentrations, float)
    if not np.all(z <= 0.0):
        raise BadInput("concentrations about a mode must be at most 0; give -2 / sigma_rad^2")
    return make_bingham(left_matrix(mode), np.concatenate([np.zeros((*z.shape[:-1], 1)), z], axis=-1))


def from_parameter_matrix(matrix: ArrayLike) -> Bingham:
    """Return the distributions proportional to exp(x^T A x) for symmetric A (..., d, d)."""
    eigenvalues, axes = np.linalg.eigh(_symmetric(matrix, "Bingham parameter matrix"))
    return Bingham(axes, eigenvalues - eigenvalues[..., -1:])


def parameter_matrix(bingham: Bingham) -> NDArray[np.float64]:
    """Return M Z M^T (..., d, d)."""
    return _spectral(bingham.axes, bingham.concentrations)


def log_normaliser(concentrations: ArrayLike) -> NDArray[np.float64]:
    """Compute ln F (...) for concentrations (..., d) by (5); (6) and (14) misprint d / 2."""
    z = np.asarray(concentrations, float)
    top = z.max(axis=-1)
    integrand, _ = _on_contour(z - top[..., None])
    return top + np.log(2.0 * np.pi ** (0.5 * z.shape[-1]) * _sum(integrand))


def square_moments(concentrations: ArrayLike) -> NDArray[np.float64]:
    """Compute E(x_i^2) = dF/dz_i / F along the principal axes (..., d); they sum to 1."""
    z = np.asarray(concentrations, float)
    integrand, factors = _on_contour(z - z.max(axis=-1, keepdims=True))
    return 0.5 * _sum(integrand[..., None, :] * factors) / _sum(integrand)[..., None]


def covariance(bingham: Bingham) -> NDArray[np.float64]:
    """Compute E(x x^T), (..., d, d), by (16); the density is even, so the mean is 0."""
    return _spectral(bingham.axes, square_moments(bingham.concentrations))


def log_density(bingham: Bingham, x: ArrayLike) -> NDArray[np.float64]:
    """Compute the log density (...) at unit vectors; the paper's (10)-(11) misprint 1 / F as F.

    Args:
        bingham: the distributions, batch axes (...).
        x: (..., d), unit vectors.
    """
    along = np.einsum("...ij,...i->...j", bingham.axes, np.asarray(x, float))
    exponent = (bingham.concentrations * along**2).sum(-1)
    return exponent - log_normaliser(bingham.concentrations)


def fit(second_moment: ArrayLike) -> Bingham:
    """Fit the maximum-likelihood distributions: E(x x^T) = `second_moment` (..., d, d), (13)-(14).

    Raises BadInput if the trace of a matrix is not 1, or if a matrix is not positive definite, since its
    concentration would diverge.
    """
    moment = _symmetric(second_moment, "second moment of a Bingham distribution")
    shape, d = moment.shape[:-2], moment.shape[-1]
    if not np.allclose(np.trace(moment, axis1=-2, axis2=-1), 1.0, rtol=0.0, atol=1e-9):
        raise BadInput(
            "the second moment of unit vectors must have trace 1; divide the matrix by its trace"
        )
    axes, z = np.empty((*shape, d, d)), np.empty((*shape, d))
    converged = kernels.fit_each(
        moment.reshape(-1, d, d).copy(), axes.reshape(-1, d, d), z.reshape(-1, d)
    )
    if not converged.all():
        index = np.unravel_index(int(np.argmin(converged)), shape)
        place = f" at {tuple(map(int, index))}" if shape else ""
        raise BadInput(
            f"no Bingham distribution has the second moment{place}: an eigenvalue is not positive, "
            "so its concentration diverges; give a positive definite matrix"
        )
    return Bingham(axes, z)


def product(first: Bingham, second: Bingham) -> Bingham:
    """Return the normalised product of two densities (lemma 1)."""
    return from_parameter_matrix(parameter_matrix(first) + parameter_matrix(second))


def likelihood(noise: Bingham, measurement: ArrayLike) -> Bingham:
    """Return the likelihood factor of an update: the density of x given z = x (+) v, (52)-(53).

    M is z (+) (D M^v); (53) and algorithm 2 misprint M^p, and the left factor in (52) is Q_z.

    Args:
        noise: distribution of v.
        measurement: z (..., d), unit vectors.
    """
    z = require_unit(measurement, "measurement")
    mirrored = np.swapaxes(conjugate(np.swapaxes(noise.axes, -1, -2)), -1, -2)
    return Bingham(left_matrix(z) @ mirrored, np.broadcast_to(noise.concentrations, z.shape))


def rotate(bingham: Bingham, increment: ArrayLike) -> Bingham:
    """Return the distributions of x (+) u for known unit increments u (..., d), such as gyro rotations.

    Args:
        bingham: the distributions, batch axes (...).
        increment: u (..., d), unit vectors.
    """
    turned = right_matrix(require_unit(increment, "increment")) @ bingham.axes
    return Bingham(turned, np.broadcast_to(bingham.concentrations, turned.shape[:-1]))


def compose(first: Bingham, second: Bingham) -> Bingham:
    """Fit Bingham distributions to the second moments of x (+) y, x ~ `first` and y ~ `second`.

    Lemmas 2 and 4 with (13)-(14). If a fit does not converge, its distribution is NaN.
    """
    shape = np.broadcast_shapes(first.concentrations.shape, second.concentrations.shape)
    batch, d = shape[:-1], shape[-1]
    axes = flatten(first.axes, batch, d, d).copy()
    z = flatten(first.concentrations, batch, d).copy()
    z[~kernels.predict_each(axes, z, flatten(covariance(second), batch, d, d))] = np.nan
    return Bingham(axes.reshape(*batch, d, d), z.reshape(*batch, d))


def sample(bingham: Bingham, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Draw `count` exact samples (..., count, d) from every distribution."""
    axes, z = bingham
    wide = (*z.shape[:-1], count, z.shape[-1])
    return sample_bingham(axes[..., None, :, :], np.broadcast_to(z[..., None, :], wide), generator)


def hemisphere_covariance(bingham: Bingham) -> NDArray[np.float64]:
    """Compute E((x - m)(x - m)^T), (..., d, d), over the hemisphere about the mode m.

    This is the covariance of a Gaussian about that mode, (57), which lacks a factor of 2 in the paper.
    E|x_d|, on which it depends, is also exact: its integrand has an additional factor (s - z_d)^(-1/2).
    """
    integrand, factors = _on_contour(bingham.concentrations)
    absolute = _sum(integrand * np.sqrt(factors[..., -1, :])) / (np.sqrt(np.pi) * _sum(integrand))
    spread = square_moments(bingham.concentrations)
    spread[..., -1] += 1.0 - 2.0 * absolute
    return _spectral(bingham.axes, spread)


def fit_projected_gaussian(mean: ArrayLike, gaussian_covariance: ArrayLike) -> Bingham:
    """Fit the Bingham distribution with the second moment of g / |g|, g ~ N(mean, covariance).

    The result is exact up to rounding: with 1 / |g|^2 = int exp(-t |g|^2) dt, one integral over t > 0
    remains, and the trapezoidal rule in log t converges geometrically.

    Args:
        mean: (d,), with d = 2 or 4.
        gaussian_covariance: (d, d).
    """
    variance, axes = np.linalg.eigh(_symmetric(gaussian_covariance, "Gaussian covariance"))
    if variance[0] < -1e-12 * variance[-1]:
        raise BadInput("a Gaussian covariance must have no negative eigenvalues")
    variance = np.maximum(variance, 0.0)
    along = np.asarray(mean, float) @ axes
    log_t, step = np.linspace(-40.0, 80.0, 1201, retstep=True)
    t = np.exp(log_t)[:, None]
    shrink = 1.0 / (1.0 + 2.0 * t * variance)
    weights = step * np.exp(log_t + (0.5 * np.log(shrink) - t * shrink * along**2).sum(-1))
    shrunk = along * shrink
    moment = np.diag(weights @ (variance * shrink)) + (weights[:, None] * shrunk).T @ shrunk
    return fit(axes @ moment @ axes.T)


def _on_contour(z: NDArray) -> tuple[NDArray, NDArray]:
    """Return the integrand (..., nodes) of F / (2 pi^(d/2)), and 1 / (s - z_k) (..., d, nodes)."""
    factors = 1.0 / (kernels.CONTOUR - z[..., None])
    return kernels.WEIGHTS * np.sqrt(factors).prod(-2), factors


def _sum(integrand: NDArray) -> NDArray[np.float64]:
    return integrand.real.sum(-1)


def _spectral(axes: NDArray, values: NDArray) -> NDArray[np.float64]:
    return (axes * values[..., None, :]) @ np.swapaxes(axes, -1, -2)


def _symmetric(matrix: ArrayLike, what: str) -> NDArray[np.float64]:
    """Make `matrix` exactly symmetric; raise BadInput if it is not nearly symmetric and finite."""
    matrix = np.asarray(matrix, float)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2] or matrix.shape[-1] not in (2, 4):
        raise BadInput(f"{what} has shape {matrix.shape}; give (..., d, d) with d = 2 or 4")
    transposed = np.swapaxes(matrix, -1, -2)
    if not np.isfinite(matrix).all() or not np.allclose(matrix, transposed, rtol=1e-9, atol=1e-12):
        raise BadInput(f"{what} must be a finite symmetric matrix")
    return 0.5 * (matrix + transposed)
