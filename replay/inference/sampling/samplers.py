"""Samplers of N(0, I), with a common interface for filters.

Sources: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section I.B; the randomised set is from Dunik, Straka and Simandl, "The Development of a Randomised
Unscented Kalman Filter", IFAC 2011.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling.distance import Array

Shape = tuple[int, ...]


class Samples(NamedTuple):
    """Points (..., L, N) and their weights (..., L), which sum to 1 and may be negative."""

    points: Array
    weights: Array


@dataclass(frozen=True)
class Sampler:
    """Sampler for one dimension.

    `draw(generator, batch)` returns points (*batch, count, dimension) and weights (*batch, count).
    Unless `redrawn` is true, points and weights are read-only views of one set, and the generator is not
    used. Consecutive batches contain the same samples as one batch of the total size, so the division of
    a log into blocks does not matter.
    """

    dimension: int
    count: int
    redrawn: bool
    draw: Callable[[Generator, Shape], Samples]


def fixed(samples: Samples) -> Sampler:
    """Make the sampler that always returns this set (L, N)."""
    count, dimension = samples.points.shape
    return Sampler(dimension, count, False, partial(_repeat, samples))


def randomised(dimension: int, iterations: int) -> Sampler:
    """Make the sampler of `randomised_unscented`."""
    count = 2 * dimension * iterations + 1
    return Sampler(dimension, count, True, partial(randomised_unscented, dimension, iterations))


def _repeat(samples: Samples, _: Generator, batch: Shape) -> Samples:
    return Samples(*(np.broadcast_to(part, batch + part.shape) for part in samples))


def unscented(dimension: int, kappa: float = 0.5) -> Samples:
    """Return the 2N+1 points of the unscented transform; kappa = 1/2 makes all weights equal.

    Raises:
        BadInput: N + kappa is not positive.
    """
    spread = dimension + kappa
    if not spread > 0:
        raise BadInput(
            f"kappa = {kappa} gives no valid covariance in {dimension} dimensions; give a value above "
            f"{-dimension}"
        )
    weights = np.full(2 * dimension + 1, 1 / (2 * spread))
    weights[0] = kappa / spread
    arms = np.sqrt(spread) * np.eye(dimension)
    return Samples(np.concatenate([np.zeros((1, dimension)), arms, -arms]), weights)


def axis_points(dimension: int, per_axis: int) -> Samples:
    """Return the Gaussian filter's set: `per_axis` points on each axis, with equal weights.

    On an axis, the points are the medians of D slices of equal probability, Phi(x_i) = (2i-1) / (2D),
    scaled so that the whole set has covariance I. With an odd D the axes share their centre: L = N (D -
    1) + 1, otherwise N D. With D = 2 this is the cubature rule, with D = 3 the equally weighted
    unscented set.
    """
    from scipy.special import ndtri  # slow to import

    quantiles = ndtri((np.arange(per_axis) + 0.5) / per_axis)
    half = quantiles[(per_axis + 1) // 2 :]
    line = np.concatenate([half, -half])
    centre = np.zeros((per_axis % 2, dimension))
    points = np.concatenate([centre, np.kron(np.eye(dimension), line[:, None])])
    count = len(points)
    return Samples(points * np.sqrt(count / np.sum(line**2)), np.full(count, 1 / count))


def randomised_unscented(
    dimension: int, iterations: int, generator: Generator, batch: Shape = ()
) -> Samples:
    """Draw 2 N iterations + 1 points: one unscented set per iteration, with random rotation and radius.

    With Q uniform over rotations and rho^2 ~ chi2(N + 2), an iteration's points are +- rho Q e_i with
    weight 1 / (2 rho^2 iterations) each; the centre has the remaining weight, which may be negative.
    Every draw integrates cubic functions exactly, and any other function without bias.
    """
    rotation_size = dimension**2
    normals = generator.standard_normal((*batch, iterations, rotation_size + dimension + 2))
    rotations = _orthonormal(
        normals[..., :rotation_size].reshape(*batch, iterations, dimension, dimension)
    )
    radii_squared = np.sum(normals[..., rotation_size:] ** 2, axis=-1)
    arms = np.sqrt(radii_squared)[..., None, None] * rotations
    arms = arms.reshape(*batch, iterations * dimension, dimension)
    arm_weights = np.repeat(1 / (2 * iterations * radii_squared), dimension, axis=-1)
    centre_weight = 1 - 2 * np.sum(arm_weights, axis=-1, keepdims=True)
    return Samples(
        np.concatenate([np.zeros((*batch, 1, dimension)), arms, -arms], axis=-2),
        np.concatenate([centre_weight, arm_weights, arm_weights], axis=-1),
    )


def rotated(samples: Samples, generator: Generator) -> Samples:
    """Rotate (or reflect) the set by a matrix that is drawn uniformly."""
    dimension = samples.points.shape[-1]
    rotation = _orthonormal(generator.standard_normal((dimension, dimension)))
    return samples._replace(points=samples.points @ rotation)


def _orthonormal(normals: Array) -> Array:
    """Convert matrices (..., N, N) of standard normals to orthogonal ones, uniform over the group.

    The QR decomposition is uniform only if its R has a positive diagonal (Mezzadri 2007).
    """
    q, r = np.linalg.qr(normals)
    turned: Array = q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]
    return turned
