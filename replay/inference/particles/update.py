"""Update of particles: each is weighted by the likelihood of the measurement."""

from typing import Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.steps import (
    NOT_EXPLAINED,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    InnovationRecord,
    Measurement,
    UpdateRun,
)
from fuselog.replay.inference.kalman.update import (
    is_unmeasured,
    message_layout,
    residual_of,
    sensor_noise,
    write_numbers,
    writing_innovation,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    LOG_TWO_PI,
    cholesky,
    drop_missing,
    whiten,
    wrap,
)
from fuselog.replay.inference.linear_algebra.inflation import inflation
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative
from fuselog.replay.inference.linear_algebra.tuples import filling, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.particles.particles import Cloud, ParticleMemory, SensorMemory, reweigh
from fuselog.replay.inference.particles.progressive import Likelihood, Look, Take, taking_in_parts


class CompareParticles(Protocol):
    """Function that fills a sensor's differences at particles (N, n), and its noise."""

    def __call__(
        self, states: Floats, data: Floats, parameters: Settings, memory: ParticleMemory, /
    ) -> None: ...


def weighing(bound_model: BoundModel, number: int, *, progressive: bool) -> UpdateRun:
    """Make the update by sensor `number`, which weights particles by the likelihood of the measurement.

    The recorded innovation, its NIS and the gate use the first two moments of the cloud; the
    log-likelihood is computed from the weighted particles. A component that no particle can predict is
    left out. A particle that cannot predict one of the other components keeps its fraction of the total
    weight.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        progressive: whether a measurement may be processed in parts.
    """
    sensor = bound_model.sensors[number]
    m, write_innovation = len(sensor.measured), writing_innovation(bound_model, number)
    compare, likelihood = _comparing(bound_model, number), _likelihood(bound_model, number)
    take = _at_once(likelihood)
    if progressive:
        look = _looking(compare, number) if sensor.log_likelihood is None else _as_before
        take = taking_in_parts(bound_model.model, look, likelihood)
    angular = tuple(kind == "angle" for kind in sensor.measured.values())

    def update(
        run: int,
        cloud: Cloud,
        measurement: Measurement,
        memory: ParticleMemory,
        record: InnovationRecord,
    ) -> int:
        data, parameters, gate, _ = measurement
        if is_unmeasured(data, m):
            return NOTHING_MEASURED
        weight, own = cloud.weight[run], memory.sensors[number]
        compare(cloud.states[run], data, parameters, memory)
        kept = keep_predicted(own)
        innovate(weight, own, kept, angular)
        write_innovation(own.innovation, record)
        size = drop_missing(own.innovation)
        squared, determinant = whiten(own.innovation, size)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        accepted = size > 0 and squared <= gate[size]
        write_numbers(record, squared, determinant, size, accepted, 1.0)
        if not accepted:
            return ALL_WELL
        factor_kept(own, kept)
        record.numbers[1], well = take(run, cloud, data, parameters, memory, own, kept)
        if not well:
            return NOT_POSITIVE_DEFINITE
        return NOT_EXPLAINED if np.isnan(record.numbers[1]) else ALL_WELL

    return update


def _at_once(likelihood: Likelihood) -> Take:
    """Make `take` (see `taking_in_parts`), which processes a measurement as a whole."""

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
        for i in range(len(weight)):
            found[i] = likelihood(states, i, data, parameters, own, kept)
        return reweigh(weight, found, 1.0), True

    return take


def _looking(compare: CompareParticles, number: int) -> Look:
    """Make `look` (see `taking_in_parts`) for the likelihood of Gaussian noise."""

    def look(
        states: Floats, data: Floats, parameters: Settings, memory: ParticleMemory, kept: int
    ) -> int:
        compare(states, data, parameters, memory)
        kept = keep_predicted(memory.sensors[number])
        factor_kept(memory.sensors[number], kept)
        return kept

    return look


def _as_before(
    states: Floats, data: Floats, parameters: Settings, memory: ParticleMemory, kept: int
) -> int:
    """Return `kept`, for a likelihood that depends only on the state and needs no preparation."""
    return kept


def _comparing(bound_model: BoundModel, number: int) -> CompareParticles:
    """Make `compare(states, data, parameters, memory)`, which fills a sensor's differences and noise."""
    model, sensor = bound_model.model, bound_model.sensors[number]
    measure, fill = sensor.measure, filling(len(sensor.measured))
    read_state, read_reference = tuple_of(model.size), message_layout(sensor).reference
    add_noise, subtract = sensor_noise(sensor), residual_of(sensor)

    def predict_alike(
        states: Floats, i: int, data: Floats, parameters: Settings, memory: ParticleMemory
    ) -> None:
        fill(memory.work.predicted, measure(read_state(states[i]), read_reference(data), parameters))

    predict = predict_alike
    if sensor.noises:
        entering = Input("noise", ("linear",) * sensor.noises, "noise_gain", zero=True)
        kinds = tuple(sensor.measured.values())
        inputs = [Input("state", model.kinds), entering]
        linearise = derivative(measure, inputs, kinds, "predicted")

        def predict_with_noise(
            states: Floats, i: int, data: Floats, parameters: Settings, memory: ParticleMemory
        ) -> None:
            linearise(read_state(states[i]), read_reference(data), parameters, memory.work)
            memory.sensors[number].noise[i] = 0.0
            add_noise(memory.sensors[number].noise[i], data, parameters, memory.work)

        predict = predict_with_noise

    def compare(states: Floats, data: Floats, parameters: Settings, memory: ParticleMemory) -> None:
        own = memory.sensors[number]
        if len(own.noise) == 1:
            own.noise[0] = 0.0
            add_noise(own.noise[0], data, parameters, memory.work)
        for i in range(len(states)):
            predict(states, i, data, parameters, memory)
            subtract(data, memory.work.predicted, own.differences[i])

    return compare


def keep_predicted(own: SensorMemory) -> int:
    """List the measured components that at least one particle can predict, and return their number."""
    size = 0
    for j in range(len(own.kept)):
        for i in range(len(own.differences)):
            if not np.isnan(own.differences[i, j]):
                own.kept[size] = j
                size += 1
                break
    return size


def is_predicted(own: SensorMemory, i: int, size: int) -> bool:
    """Test whether a particle can predict all used components."""
    for a in range(size):
        if np.isnan(own.differences[i, own.kept[a]]):
            return False
    return size > 0


def innovate(weight: Floats, own: SensorMemory, size: int, angular: tuple[bool, ...]) -> None:
    """Fill the innovation of the cloud: mean and covariance of the differences, plus the noise.

    Angles are unwrapped relative to the difference of the first particle with a prediction.

    Args:
        weight: (N,).
        own: memory of the sensor, with the differences and the noise.
        size: number of components that are used.
        angular: (m,) whether each component is an angle.
    """
    mean, spread, _ = own.innovation
    mean[:], spread[:, :] = np.nan, 0.0
    for a in range(size):
        mean[own.kept[a]] = 0.0
    first, total = -1, 0.0
    for i in range(len(weight)):
        if not is_predicted(own, i, size):
            continue
        first = i if first < 0 else first
        total += weight[i]
        noise = own.noise[i if len(own.noise) > 1 else 0]
        for a in range(size):
            j = own.kept[a]
            away = wrap(own.differences[i, j] - own.differences[first, j], angular[j])
            mean[j] += weight[i] * away
            for b in range(a + 1):
                k = own.kept[b]
                other = wrap(own.differences[i, k] - own.differences[first, k], angular[k])
                spread[j, k] += weight[i] * (away * other + noise[j, k])
    for a in range(size):
        j = own.kept[a]
        mean[j] = mean[j] / total
        for b in range(a + 1):
            k = own.kept[b]
            spread[j, k] = spread[k, j] = spread[j, k] / total - mean[j] * mean[k]
    for a in range(size):
        j = own.kept[a]
        mean[j] = wrap(own.differences[first, j] + mean[j], angular[j])


def factor_kept(own: SensorMemory, size: int) -> None:
    """Factor the noise of the used components, move it to the front, and compute log det.

    The log det is NaN if the covariance is not positive definite.
    """
    for number in range(len(own.noise)):
        noise, determinant = own.noise[number], 1.0
        for a in range(size):
            for b in range(a + 1):
                noise[a, b] = noise[own.kept[a], own.kept[b]]
        if not cholesky(noise, noise, size):
            own.determinant[number] = np.nan
            continue
        for a in range(size):
            determinant *= noise[a, a]
        own.determinant[number] = 2.0 * np.log(determinant)


def _likelihood(bound_model: BoundModel, number: int) -> Likelihood:
    """Make `likelihood(states, i, data, parameters, own, size)`, the log-likelihood at particle i.

    It uses the model's likelihood function if there is one; otherwise, it assumes Gaussian noise. The
    result is NaN if the particle cannot predict the measurement.
    """
    sensor = bound_model.sensors[number]
    if sensor.log_likelihood is None:
        return gaussian_likelihood
    stated, read_state = sensor.log_likelihood, tuple_of(bound_model.model.size)
    _, read_measured, read_reference, _ = message_layout(sensor)

    def likelihood(
        states: Floats, i: int, data: Floats, parameters: Settings, own: SensorMemory, size: int
    ) -> float:
        return stated(read_state(states[i]), read_measured(data), read_reference(data), parameters)

    return likelihood


def gaussian_likelihood(
    states: Floats, i: int, data: Floats, parameters: Settings, own: SensorMemory, size: int
) -> float:
    """Compute the log-likelihood for Gaussian noise, and replace the difference by L^-1 v.

    Args:
        states: (N, n), not used, because the differences are known.
        i: index of the particle.
        data: (width,) data of the event, not used.
        parameters: parameters of the sensor, for `inflation`.
        own: memory of the sensor, with differences and the factors of noise.
        size: number of components that are used.
    """
    number = i if len(own.noise) > 1 else 0
    difference, lower, squared = own.differences[i], own.noise[number], 0.0
    for a in range(size):
        entry = difference[own.kept[a]]
        for b in range(a):
            entry -= lower[a, b] * difference[b]
        difference[a] = entry / lower[a, a]
        squared += difference[a] * difference[a]
    factor, wider = inflation(squared, size, parameters), 0.0
    if factor != 1.0:
        squared, wider = squared / factor, np.log(factor)
    known = own.determinant[number] + size * LOG_TWO_PI
    logarithm: float = -0.5 * (squared + known + size * wider)
    return logarithm
