"""Prediction and resampling of the bootstrap particle filter, with separate noise for each particle.

All noise is sampled: additive noise, noise of the control, and noise within the motion. A measurement
weights the particles by its likelihood; they are resampled before a prediction if few of them are
effective. The estimate is the mean and covariance of the weighted particles, in the tangent space.

Gordon, Salmond and Smith, IEE Proceedings F 140(2), 1993; systematic resampling: Kitagawa 1996.
"""

from typing import NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers, Numbers
from fuselog.replay.engine.philox import Words, fill_normals, philox, unit
from fuselog.replay.inference.kalman.predict import nothing
from fuselog.replay.inference.kalman.regression import settling
from fuselog.replay.inference.kalman.steps import EstimateRun, Gaussian, Interval, PredictRun, Workspace
from fuselog.replay.inference.linear_algebra.gaussian import (
    Innovation,
    semidefinite_cholesky,
)
from fuselog.replay.inference.linear_algebra.manifold import Boxplus, boxminus, boxplus
from fuselog.replay.inference.linear_algebra.moments import (
    lower_of,
    moments_of,
    offset_of,
    weighted_mean_of,
)
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, filling, range_of, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.sampling.resampling import choose_systematically


class Cloud(NamedTuple):
    """Particles of all runs; the first axis is the run.

    Attributes:
        prior: Gaussian from which the particles are drawn.
        states: (runs, N, n).
        weight: (runs, N), with sum 1.
        offsets, shift: (runs, N, t), (runs, t) working memory for tangent vectors from the mean to the
            states.
        key, counter: (runs, 2), (runs,) state of the run's random generator; the counter is 0 before the
        first draw.
    """

    prior: Gaussian
    states: Floats
    weight: Floats
    offsets: Floats
    shift: Floats
    key: Words
    counter: Integers


class Clouds(NamedTuple):
    """Estimates that the recursion fills (`recursion.EstimateRows`), with or without particles.

    `effective` (n,) is the effective number of particles.
    """

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    effective: Floats
    states: Floats
    weight: Floats


class SensorMemory(NamedTuple):
    """Working memory of the update by one sensor of m components.

    Attributes:
        innovation: innovation of the cloud as a whole.
        differences: (N, m) measured minus predicted.
        noise: (1 or N, m, m) covariance of the noise, later replaced by its factor; the first axis has N
            entries if the particles have different noise.
        determinant: (1 or N,) log det of the covariance.
        kept: (m,) indices of the components that are used.
    """

    innovation: Innovation
    differences: Floats
    noise: Floats
    determinant: Floats
    kept: Integers


class Kernel(NamedTuple):
    """Working memory to spread resampled particles; see `progressive`.

    Attributes:
        width: width of the Gaussian kernel, relative to the standard deviation of the cloud.
        numbers, words, drawn: normal random numbers, the random words from which they are made, and the
            numbers as (N, t).
        mean, covariance: (n,), (t, t) mean and covariance of the cloud; the covariance is later replaced
            by its factor.
        trial: (N,) weights.
    """

    width: float
    numbers: Floats
    words: Words
    drawn: Floats
    mean: Floats
    covariance: Floats
    trial: Floats


class ParticleMemory(NamedTuple):
    """Working memory of the steps of one core.

    Attributes:
        least_effective: effective number below which particles are resampled.
        numbers, words, drawn: normal random numbers, the random words from which they are made, and the
            numbers as (N, noises of the motion).
        control, noise: (controls,), (noises of the motion,) samples for one particle.
        lower: (t, t) factor of the covariance of additive noise.
        chosen, spare: (N,), (N, n) for resampling.
        likelihood: (N,) logarithms.
        sensors: memory of each sensor.
        work: workspace for derivatives with respect to noise.
        kernel: memory to spread the particles; empty if they are not spread.
    """

    least_effective: float
    numbers: Floats
    words: Words
    drawn: Floats
    control: Floats
    noise: Floats
    lower: Floats
    chosen: Integers
    spare: Floats
    likelihood: Floats
    sensors: tuple[SensorMemory, ...]
    work: Workspace
    kernel: Kernel


class Renew(Protocol):
    """Function that resamples the particles of a run and returns whether it succeeded."""

    def __call__(self, run: int, cloud: Cloud, memory: ParticleMemory, /) -> bool: ...


class Drive(Protocol):
    """Function that returns the control (controls,) for a particle, including any random error."""

    def __call__(self, interval: Interval, drawn: Floats, memory: ParticleMemory, /) -> Numbers: ...


class MoveParticle(Protocol):
    """Function that returns a state (n,) after the motion, including drawn noise."""

    def __call__(
        self,
        state: Numbers,
        driven: Numbers,
        drawn: Floats,
        interval: Interval,
        memory: ParticleMemory,
        /,
    ) -> Numbers: ...


class SpreadParticles(Protocol):
    """Function that fills offsets (N, t) with samples of the additive noise at states (N, n).

    It returns False if a covariance is not positive semidefinite.
    """

    def __call__(
        self, states: Floats, offsets: Floats, interval: Interval, memory: ParticleMemory, /
    ) -> bool: ...


def moving(bound_model: BoundModel, by_control: int, renew: Renew) -> PredictRun:
    """Make the prediction: resample if necessary, then move every particle with its own noise.

    Args:
        bound_model: the bound model.
        by_control: number of a particle's random numbers that are errors of the control; these come
            first.
        renew: `renew(run, cloud, memory)` resamples and returns whether it succeeded.
    """
    model, motion = bound_model.model, bound_model.motion
    read_state, fill, add = tuple_of(model.size), filling(model.size), boxplus(model.kinds)
    drive, move = _driving(bound_model), _moved(bound_model, by_control)
    is_additive = motion.noise is not None and not motion.noises
    spread = _additive_noise(bound_model, by_control) if is_additive else _no_noise
    scatter: Boxplus = add if is_additive else nothing

    def predict(run: int, cloud: Cloud, interval: Interval, memory: ParticleMemory) -> bool:
        states, offsets, key = cloud.states[run], cloud.offsets[run], cloud.key[run]
        if effective_number(cloud.weight[run]) < memory.least_effective and not renew(
            run, cloud, memory
        ):
            return False
        cloud.counter[run] = fill_normals(memory.numbers, memory.words, key, cloud.counter[run])
        if not spread(states, offsets, interval, memory):
            return False
        for i in range(len(states)):
            drawn = memory.drawn[i]
            driven = drive(interval, drawn, memory)
            fill(states[i], move(read_state(states[i]), driven, drawn, interval, memory))
            scatter(states[i], offsets[i])
        return True

    return predict


def resampling(run: int, cloud: Cloud, memory: ParticleMemory) -> bool:
    """Resample without spreading the particles, and return True."""
    states, weight, key = cloud.states[run], cloud.weight[run], cloud.key[run]
    cloud.counter[run] = resample(states, weight, key, cloud.counter[run], memory)
    return True


def resample(states: Floats, weight: Floats, key: Words, counter: int, memory: ParticleMemory) -> int:
    """Resample the particles to equal weights, and return the new counter.

    Args:
        states: (N, n).
        weight: (N,).
        key: (2,) key of the run's random generator.
        counter: counter of the generator.
        memory: working memory.
    """
    choose_systematically(weight, unit(philox(counter + 1, key)[0]), memory.chosen)
    for i in range(len(weight)):
        memory.spare[i] = states[memory.chosen[i]]
    weight[:] = 1.0 / len(weight)
    states[:, :] = memory.spare
    return counter + 1


def effective_number(weight: Floats) -> float:
    """Compute the effective number 1 / sum w^2 of particles with these weights (N,)."""
    squared = 0.0
    for i in range(len(weight)):
        squared += weight[i] * weight[i]
    return 1.0 / squared


def reweigh(weight: Floats, likelihood: Floats, power: float) -> float:
    """Multiply weights, which sum to 1, by a power of likelihoods, and normalise them.

    A particle whose likelihood is NaN gets the mean likelihood of all other particles.

    Args:
        weight: (N,), changed in place.
        likelihood: (N,) logarithms.
        power: exponent of the likelihoods.

    Returns:
        log sum w p^power; NaN, with meaningless weights, if no likelihood is positive.
    """
    best = -np.inf
    for i in range(len(weight)):
        if weight[i] > 0.0 and likelihood[i] > best:
            best = likelihood[i]
    share, total = 0.0, 0.0
    for i in range(len(weight)):
        if not np.isnan(likelihood[i]):
            share += weight[i]
            weight[i] *= np.exp(power * (likelihood[i] - best))
            total += weight[i]
    mean = total / share
    for i in range(len(weight)):
        weight[i] *= 1.0 / mean if not np.isnan(likelihood[i]) else 1.0
    return power * best + np.log(mean) if best > -np.inf else np.nan


def _driving(bound_model: BoundModel) -> Drive:
    """Make `drive(interval, drawn, memory)`, which returns the control of a particle as a tuple."""
    controls, variances = bound_model.model.controls, bound_model.motion.control_noise
    read, fill = tuple_of(controls), filling(controls)
    if variances is None:

        def as_stated(interval: Interval, drawn: Floats, memory: ParticleMemory) -> Numbers:
            return read(interval.control)

        return as_stated

    def with_error(interval: Interval, drawn: Floats, memory: ParticleMemory) -> Numbers:
        fill(memory.control, variances(interval.duration_s, interval.parameters))
        for k in range(controls):
            memory.control[k] = interval.control[k] + np.sqrt(memory.control[k]) * drawn[k]
        return read(memory.control)

    return with_error


def _moved(bound_model: BoundModel, first: int) -> MoveParticle:
    """Make `moved(state, driven, drawn, interval, memory)`, which returns a state after the motion."""
    move, variances, noises = (
        bound_model.motion.move,
        bound_model.motion.noise,
        bound_model.motion.noises,
    )
    if not noises:

        def without(
            state: Numbers, driven: Numbers, drawn: Floats, interval: Interval, memory: ParticleMemory
        ) -> Numbers:
            return move(state, driven, interval.duration_s, interval.parameters)

        return without
    assert variances is not None
    read, fill = tuple_of(noises), filling(noises)

    def with_noise(
        state: Numbers, driven: Numbers, drawn: Floats, interval: Interval, memory: ParticleMemory
    ) -> Numbers:
        _, duration_s, parameters, _ = interval
        fill(memory.noise, variances(state, duration_s, parameters))
        for k in range(noises):
            memory.noise[k] = np.sqrt(memory.noise[k]) * drawn[first + k]
        return move(state, driven, read(memory.noise), duration_s, parameters)

    return with_noise


def _no_noise(states: Floats, offsets: Floats, interval: Interval, memory: ParticleMemory) -> bool:
    return True


def _additive_noise(bound_model: BoundModel, first: int) -> SpreadParticles:
    """Make `spread(states, offsets, interval, memory)`, which draws the additive noise.

    The samples are tangent vectors at the states before the motion. The covariance of the noise is
    factored only if it differs from that of the previous particle. The function returns False if a
    covariance is not positive semidefinite.
    """
    t, noise = bound_model.model.tangent, bound_model.motion.noise
    assert noise is not None
    read_state = tuple_of(bound_model.model.size)
    add_noise = adding_noise(t, bound_model.motion.noise_block)
    read_lower, offset, fill = lower_of(t), offset_of(t), filling(t)

    def factored(lower: Floats, variances: Numbers) -> bool:
        lower[:, :] = 0.0
        add_noise(lower, variances)
        return semidefinite_cholesky(lower, lower, t)

    def spread(states: Floats, offsets: Floats, interval: Interval, memory: ParticleMemory) -> bool:
        _, duration_s, parameters, _ = interval
        before, drawn = noise(read_state(states[0]), duration_s, parameters), memory.drawn[:, first:]
        if not factored(memory.lower, before):
            return False
        lower = read_lower(memory.lower)
        for i in range(len(states)):
            found = noise(read_state(states[i]), duration_s, parameters)
            if found != before:
                before = found
                if not factored(memory.lower, found):
                    return False
                lower = read_lower(memory.lower)
            fill(offsets[i], offset(lower, drawn, i))
        return True

    return spread


def summing_up(model: Model) -> EstimateRun:
    """Make `estimate`, which computes intrinsic mean and covariance, and particles if requested."""
    n, t = model.size, model.tangent
    subtract, settle, moments = boxminus(model.kinds), settling(model.kinds), moments_of(0, range_of(t))
    weighted_mean, straight = weighted_mean_of(range_of(n)), set(model.kinds) <= {"linear"}

    def estimate(run: int, cloud: Cloud, clouds: Clouds, row: int, _: ParticleMemory) -> None:
        states, weight, offsets = cloud.states[run], cloud.weight[run], cloud.offsets[run]
        mean, covariance, shift = clouds.mean[row], clouds.covariance[row], cloud.shift[run]
        if straight:
            weighted_mean(weight, states, mean)
            moments(weight, states, states, mean, covariance, covariance)
        else:
            mean[:] = states[0]
            for i in range(len(states)):
                subtract(states[i], mean, offsets, i)
            settle(weight, offsets, mean, shift)
            moments(weight, offsets, offsets, shift, covariance, covariance)
        clouds.effective[row] = effective_number(weight)
        kept = clouds.states.shape[1]  # all particles, or zero if they are not requested
        clouds.weight[row] = weight[:kept]
        clouds.states[row] = states[:kept]

    return estimate
