"""Progressive particle updates, which process a measurement in parts and spread resampled particles.

If a measurement is much more accurate than the cloud, only a few particles keep a significant weight;
without noise of the motion, all later particles are copies of these few. Therefore, the particles are
first weighted by a power of the likelihood, chosen so that enough particles stay effective. After
resampling, the rest of the likelihood is applied in the same way. Resampled particles are spread by a
Gaussian kernel and shrunk towards their mean, which preserves mean and covariance.

Progressive correction: Musso, Oudjane and Le Gland, "Improving regularised particle filters", 2001, in
Sequential Monte Carlo Methods in Practice; the shrinkage: West, JRSS B 55(2), 1993.
"""

from typing import Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.philox import WORDS, fill_normals
from fuselog.replay.inference.kalman.regression import settling
from fuselog.replay.inference.linear_algebra.gaussian import semidefinite_cholesky
from fuselog.replay.inference.linear_algebra.manifold import boxminus, boxplus
from fuselog.replay.inference.linear_algebra.moments import moments_of
from fuselog.replay.inference.linear_algebra.tuples import range_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.particles.particles import (
    Cloud,
    Kernel,
    ParticleMemory,
    Renew,
    SensorMemory,
    effective_number,
    resample,
    reweigh,
)

MOST_PARTS = 100  # maximum number of parts of one measurement
_HALVINGS = 10  # bisections of the interval of the power; more if the power is still too large
_MOST_HALVINGS = 60


def kernel_of(particles: int, n: int, t: int) -> Kernel:
    """Allocate memory to spread particles with n components and t tangent components.

    The width is optimal for Gaussians: Silverman, Density Estimation, 1986, eq. 4.14.
    """
    size = -(-particles * t // WORDS) * WORDS
    numbers = np.empty(size)
    return Kernel(
        width=min(1.0, (4.0 / ((t + 2.0) * max(particles, 1))) ** (1.0 / (t + 4.0))),
        numbers=numbers,
        words=np.empty(size, np.uint64),
        drawn=numbers[: particles * t].reshape(particles, t),
        mean=np.empty(n),
        covariance=np.empty((t, t)),
        trial=np.empty(particles),
    )


def renewing(model: Model) -> Renew:
    """Make `renew(run, cloud, memory)`, which resamples particles and spreads them.

    It returns False if the covariance of the particles is not positive semidefinite.
    """
    t = model.tangent
    subtract, add, settle = boxminus(model.kinds), boxplus(model.kinds), settling(model.kinds)
    moments = moments_of(0, range_of(t))

    def renew(run: int, cloud: Cloud, memory: ParticleMemory) -> bool:
        states, weight, offsets = cloud.states[run], cloud.weight[run], cloud.offsets[run]
        kernel, shift, key = memory.kernel, cloud.shift[run], cloud.key[run]
        kernel.mean[:] = states[0]
        for i in range(len(states)):
            subtract(states[i], kernel.mean, offsets, i)
        settle(weight, offsets, kernel.mean, shift)
        moments(weight, offsets, offsets, shift, kernel.covariance, kernel.covariance)
        if not semidefinite_cholesky(kernel.covariance, kernel.covariance, t):
            return False
        counter = resample(states, weight, key, cloud.counter[run], memory)
        cloud.counter[run] = fill_normals(kernel.numbers, kernel.words, key, counter)
        kept = np.sqrt(1.0 - kernel.width * kernel.width)
        for i in range(len(states)):
            subtract(states[i], kernel.mean, offsets, i)
            for k in range(t):
                offsets[i, k] *= kept
                for j in range(k + 1):
                    offsets[i, k] += kernel.width * kernel.covariance[k, j] * kernel.drawn[i, j]
            states[i] = kernel.mean
            add(states[i], offsets[i])
        return True

    return renew


class Look(Protocol):
    """Function that prepares the computation of likelihoods after particles have moved.

    It returns the number of used components.
    """

    def __call__(
        self, states: Floats, data: Floats, parameters: Settings, memory: ParticleMemory, kept: int, /
    ) -> int: ...


class Likelihood(Protocol):
    """Function that returns log p for particle i of states (N, n); NaN if p is undefined for it."""

    def __call__(
        self, states: Floats, i: int, data: Floats, parameters: Settings, own: SensorMemory, size: int, /
    ) -> float: ...


class Take(Protocol):
    """Function that weights and moves the particles of a run by a measurement; see `taking_in_parts`."""

    def __call__(
        self,
        run: int,
        cloud: Cloud,
        data: Floats,
        parameters: Settings,
        memory: ParticleMemory,
        own: SensorMemory,
        kept: int,
        /,
    ) -> tuple[float, bool]: ...


def taking_in_parts(model: Model, look: Look, likelihood: Likelihood) -> Take:
    """Make `take(run, cloud, data, parameters, memory, own, kept)`, which weights and moves particles.

    It returns the log-likelihood (NaN if no particle explains the measurement), and whether all other
    steps succeeded.

    Args:
        model: model whose state the particles have.
        look: `look(states, data, parameters, memory, kept)` prepares the computation of likelihoods
            after particles have moved, and returns the number of used components.
        likelihood: log p at one particle; see `update.weighing`.
    """
    renew = renewing(model)

    def take(
        run: int,
        cloud: Cloud,
        data: Floats,
        parameters: Settings,
        memory: ParticleMemory,
        own: SensorMemory,
        kept: int,
    ) -> tuple[float, bool]:
        states, weight, found = cloud.states[run], cloud.weight[run], memory.likelihood
        left, total = 1.0, 0.0
        for part in range(MOST_PARTS):
            for i in range(len(weight)):
                found[i] = likelihood(states, i, data, parameters, own, kept)
            share = left
            if part + 1 < MOST_PARTS:
                share = _power(weight, found, left, memory)
            total += reweigh(weight, found, share)
            if np.isnan(total):
                return total, True
            left -= share
            if left <= 0.0:
                break
            if not renew(run, cloud, memory):
                return total, False
            kept = look(states, data, parameters, memory, kept)
        return total, True

    return take


def _power(weight: Floats, likelihood: Floats, left: float, memory: ParticleMemory) -> float:
    """Find the largest power, at most `left`, at which enough particles remain effective."""
    least = memory.least_effective
    if not effective_after(weight, likelihood, left, memory.kernel.trial) < least:
        return left
    low, high = 0.0, left
    for halving in range(_MOST_HALVINGS):
        if halving >= _HALVINGS and low > 0.0:
            break
        middle = 0.5 * (low + high)
        if effective_after(weight, likelihood, middle, memory.kernel.trial) < least:
            high = middle
        else:
            low = middle
    return low if low > 0.0 else high


def effective_after(weight: Floats, likelihood: Floats, power: float, trial: Floats) -> float:
    """Compute the effective number of particles after weighting by a power of the likelihoods.

    Args:
        weight, likelihood, power: as for `reweigh`, but the weights are not changed.
        trial: (N,) working memory.
    """
    trial[:] = weight
    reweigh(trial, likelihood, power)
    return effective_number(trial)
