"""Exact noise of axes and orientations: Bingham distributions, and Gaussians projected to the sphere."""

from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters

_MOST_NEWTON_STEPS = 50


def saddlepoint(concentrations: ArrayLike) -> NDArray[np.float64]:
    """Find the root t > 0 (...) of sum_k 1 / (2 (t - z_k)) = 1 for concentrations z (..., d), maximum 0.

    It is the centre of the saddlepoint approximation of the normalization constant (Kume and Wood,
    Biometrika 92, 2005) and, with b = 2 t, tunes the envelope of the sampler below.
    """
    z = np.asarray(concentrations, float)
    # the sum is convex and decreasing, so Newton steps from 1/2, left of the root, never overshoot
    t = np.full(z.shape[:-1], 0.5)
    for _ in range(_MOST_NEWTON_STEPS):
        inverse = 0.5 / (t[..., None] - z)
        step = (inverse.sum(-1) - 1.0) / (2.0 * (inverse**2).sum(-1))
        t = t + step
        if np.all(np.abs(step) <= 1e-15 * t):
            break
    return t


def sample_bingham(
    axes: ArrayLike, concentrations: ArrayLike, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Draw one sample (..., d) from each Bingham distribution.

    Exact rejection sampling under an angular central Gaussian envelope (Kent, Ganeiban, Mardia, "A new
    unified approach for the simulation of a wide class of directional distributions", JCGS 27, 2018),
    which accepts at least 44 % of the proposals. To draw many samples from one distribution, broadcast
    it.

    Args:
        axes: (..., d, d), the principal axes as columns.
        concentrations: (..., d), finite concentrations along these axes.
        generator: random numbers for the proposals.

    Returns:
        Unit vectors (..., d).
    """
    axes, concentrations = np.asarray(axes, float), np.asarray(concentrations, float)
    if not np.all(np.isfinite(concentrations)):
        raise BadInput("Bingham concentrations must be finite to draw samples")
    d = concentrations.shape[-1]
    shape = np.broadcast_shapes(axes.shape[:-2], concentrations.shape[:-1])
    z = concentrations - concentrations.max(axis=-1, keepdims=True)
    t = saddlepoint(z)
    envelope = np.broadcast_to(1.0 - z / t[..., None], (*shape, d)).reshape(-1, d)
    bound = np.broadcast_to(t - 0.5 * d + 0.5 * d * np.log(0.5 * d / t), shape).reshape(-1)
    z = np.broadcast_to(z, (*shape, d)).reshape(-1, d)
    samples = np.empty(z.shape)
    pending = np.arange(len(z))
    while len(pending):
        proposal = generator.standard_normal((len(pending), d)) / np.sqrt(envelope[pending])
        square = proposal**2 / (proposal**2).sum(-1, keepdims=True)
        log_ratio = (z[pending] * square).sum(-1) + 0.5 * d * np.log(
            (envelope[pending] * square).sum(-1)
        )
        taken = np.log(generator.random(len(pending))) < log_ratio - bound[pending]
        samples[pending[taken]] = proposal[taken] / np.linalg.norm(
            proposal[taken], axis=-1, keepdims=True
        )
        pending = pending[~taken]
    return np.einsum("...ij,...j->...i", axes, samples.reshape(*shape, d))


def sample_projected_gaussian(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    shape: tuple[int, ...],
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw (*shape, d) samples from a Gaussian in R^d, each scaled to unit length.

    Args:
        mean: (d,).
        covariance: (d, d).
        shape: shape of the samples.
        generator: random numbers.

    Returns:
        Unit vectors (*shape, d).
    """
    drawn = generator.multivariate_normal(mean, covariance, shape, method="eigh")
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)


class DirectionalNoise(Parameters):
    """A distribution of unit complex numbers or quaternions, with one parameter per component.

    Attributes:
        distribution: kind of distribution; samples of a Gaussian are scaled to unit length.
        diagonal: concentrations of a Bingham distribution, 0 for the mode and at most 0 for the others;
            or variances of a Gaussian about the identity (1, 0, ...).
    """

    distribution: Literal["bingham", "gaussian"] = "bingham"
    diagonal: tuple[float, ...]

    @model_validator(mode="after")
    def _has_its_sign(self) -> Self:
        if len(self.diagonal) not in (2, 4):
            raise ValueError("give 2 numbers for an axis or 4 for an orientation")
        if self.distribution == "bingham" and max(self.diagonal) != 0.0:
            raise ValueError(
                "Bingham concentrations must be 0 for the mode and at most 0 for the others"
            )
        if self.distribution == "gaussian" and min(self.diagonal) < 0.0:
            raise ValueError("variances must not be negative")
        return self

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw unit vectors (count, d)."""
        d = len(self.diagonal)
        if self.distribution == "bingham":
            return sample_bingham(np.eye(d), np.broadcast_to(self.diagonal, (count, d)), rng)
        return sample_projected_gaussian(np.eye(d)[0], np.diag(self.diagonal), (count,), rng)
