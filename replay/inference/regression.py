"""Statistical linear regression: a Gaussian through a function at weighted samples of it.

Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014, (19)-(24);
(24) prints y_{k,i} where the noise sample is meant. On manifolds samples are the mean plus tangent
vectors, and means are intrinsic: the weighted differences from them sum to zero.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from replay.inference.gaussian import cholesky, weighted_product, weighted_sum, wrap
from replay.inference.generate import (
    differencing,
    filling,
    recentring,
    retraction,
    tangent_size,
    tuple_of,
)
from replay.inference.model import Motion, Sensor
from replay.inference.steps import (
    Stage,
    Workspace,
    motion_derivative,
    motion_noise,
    reading,
    sensor_noise,
)
from replay.sampling.sets import SampleSets

Floats = NDArray[np.float64]
Function = Callable[..., Any]
MEANS = 30  # at most so many steps to an intrinsic mean


class SampleMemory(NamedTuple):
    """Samples of N(0, I), and what a regression at them works in; N = t + noises.

    Attributes:
        points, weights, first, stride: see `replay.sampling.sets.SampleSets`.
        factor: (N, N) lower factor of the covariance of state (t) and noise.
        offsets: (N, L) the samples' tangent vectors from the mean.
        point, noise: (n,), (noises,), one sample.
        values: (v, L), the function's values as tangent vectors from their mean.
        centre, shift: (n of the values,), (v,), their mean and its last correction.
        cross: (t, v), for a covariance that is not needed.
    """

    points: Floats
    weights: Floats
    first: int
    stride: int
    factor: Floats
    offsets: Floats
    point: Floats
    noise: Floats
    values: Floats
    centre: Floats
    shift: Floats
    cross: Floats


def sample_memory(
    sets: SampleSets, kinds: Sequence[str], noises: int, outputs: Sequence[str]
) -> SampleMemory:
    """Memory for the regression of a function of a state and its noise."""
    _, count, dimension = sets.points.shape
    values = tangent_size(outputs)
    return SampleMemory(
        *sets,
        factor=np.zeros((dimension, dimension)),
        offsets=np.empty((dimension, count)),
        point=np.empty(len(kinds)),
        noise=np.empty(noises),
        values=np.empty((values, count)),
        centre=np.empty(len(outputs)),
        shift=np.empty(values),
        cross=np.empty((dimension - noises, values)),
    )


def regression(
    function: Function, kinds: tuple[str, ...], noises: int, outputs: tuple[str, ...]
) -> Function:
    """The regression of `function(state, noise, arguments)` at samples.

    Returns `regress(mean, covariance, arguments, variances, spread, cross, use, memory)`. It takes the
    samples of use number `use`, fills `memory.centre` with the intrinsic mean of the values, `spread`
    (v, v) with their covariance and `cross` (t, v) with that with the state; False where the state's
    covariance is not positive definite. `variances` is a tuple of those of the noise.
    """
    t, v, components = tangent_size(kinds), tangent_size(outputs), len(kinds)
    size = t + noises
    read_state, read_noise = tuple_of(components), tuple_of(noises)
    add, subtract, fill = retraction(kinds), differencing(outputs), filling(len(outputs))
    add_value, recentre = retraction(outputs), recentring(outputs)
    fill_noise = filling(noises)
    flat_states, no_noise = all(kind in ("linear", "angle") for kind in kinds), (0.0,) * noises
    straight = set(outputs) <= {"linear"}

    def spread_out(
        covariance: Floats, variances: tuple[float, ...], points: Floats, memory: SampleMemory
    ) -> bool:
        factor, offsets = memory.factor, memory.offsets
        if not cholesky(factor, covariance, t):
            return False
        fill_noise(memory.noise, variances)
        for k in range(noises):
            factor[t + k, t + k] = np.sqrt(memory.noise[k])
        for row in range(size):
            for index in range(len(points)):
                entry = 0.0
                for k in range(row + 1):
                    entry += factor[row, k] * points[index, k]
                offsets[row, index] = entry
        return True

    def evaluate(mean: Floats, arguments: tuple[Any, ...], memory: SampleMemory) -> None:
        point, offsets = memory.point, memory.offsets
        centre = function(read_state(mean), no_noise, arguments)
        fill(memory.centre, centre)
        for index in range(offsets.shape[1]):
            if flat_states:
                for row in range(components):
                    point[row] = mean[row] + offsets[row, index]
            else:
                for row in range(components):
                    point[row] = mean[row]
                add(point, offsets[:, index])
            for k in range(noises):
                memory.noise[k] = offsets[t + k, index]
            value = function(read_state(point), read_noise(memory.noise), arguments)
            subtract(value, centre, memory.values, index)

    def settle(weights: Floats, memory: SampleMemory) -> None:
        """Move the centre to the intrinsic mean, and the values with it."""
        values, shift = memory.values, memory.shift
        for _ in range(MEANS):
            for i in range(v):
                shift[i] = weighted_sum(weights, values[i])
            add_value(memory.centre, shift)
            if straight:
                for i in range(v):
                    for index in range(len(weights)):
                        values[i, index] -= shift[i]
                return
            if not recentre(values, shift):
                return

    def regress(
        mean: Floats,
        covariance: Floats,
        arguments: tuple[Any, ...],
        variances: tuple[float, ...],
        spread: Floats,
        cross: Floats,
        use: int,
        memory: SampleMemory,
    ) -> bool:
        chosen = (use - memory.first) * memory.stride
        weights = memory.weights[chosen]
        if not spread_out(covariance, variances, memory.points[chosen], memory):
            return False
        evaluate(mean, arguments, memory)
        settle(weights, memory)
        values, offsets = memory.values, memory.offsets
        for i in range(v):
            for j in range(i + 1):
                spread[i, j] = spread[j, i] = weighted_product(weights, values[i], values[j])
            for row in range(t):
                cross[row, i] = weighted_product(weights, offsets[row], values[i])
        return True

    return regress


def sampled_motion(stage: Stage, number: int) -> Function:
    """Prediction by regression at the samples `work.samples[number]`.

    Noise of the control enters by the derivative at the mean, noise of the motion itself as a sample.
    """
    model, motion = stage.model, stage.motion
    entering = motion.noise if motion.noises else None
    regress = regression(_moved(motion), model.kinds, motion.noises, model.kinds)
    variances_of = entering or _no_variances
    add_noise = _no_noise_left if entering else motion_noise(model, motion)
    linearise = motion_derivative(model, motion, by_state=False) if motion.control_noise else _unused
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    fill = filling(model.size)

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        work: Workspace,
    ) -> bool:
        memory, state, driven = work.samples[number], read_state(mean), read_control(control)
        arguments = (driven, duration_s, parameters)
        variances = variances_of(state, duration_s, parameters)
        spread, cross = work.product, memory.cross
        if not regress(mean, covariance, arguments, variances, spread, cross, use, memory):
            return False
        for row in range(len(covariance)):
            for column in range(len(covariance)):
                covariance[row, column] = spread[row, column]
        linearise(state, driven, duration_s, parameters, work)
        add_noise(state, covariance, duration_s, parameters, work)
        fill(mean, memory.centre)
        return True

    return predict


def _moved(motion: Motion) -> Function:
    move = motion.move
    if motion.noises:

        def with_noise(state: Any, noise: Any, arguments: Any) -> Any:
            return move(state, arguments[0], noise, arguments[1], arguments[2])

        return with_noise

    def without(state: Any, noise: Any, arguments: Any) -> Any:  # noqa: ARG001
        return move(state, arguments[0], arguments[1], arguments[2])

    return without


def _no_variances(state: Any, duration_s: float, parameters: Any) -> tuple[float, ...]:  # noqa: ARG001
    return ()


def _no_noise_left(
    state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any
) -> None:
    pass


def _unused(state: Any, control: Any, duration_s: float, parameters: Any, work: Any) -> None:
    pass


def sampled_sensor(stage: Stage, number: int, samples: int) -> Function:
    """`innovate(...)` of sensor `number` by regression at the samples `work.samples[samples]`."""
    model, sensor = stage.model, stage.sensors[number]
    kinds = tuple(sensor.measured.values())
    regress = regression(_measured(sensor), model.kinds, sensor.noises, kinds)
    read_about, m = reading(sensor).about, len(kinds)
    angular = tuple(kind == "angle" for kind in kinds)
    entering = sensor.noise if sensor.noises else None
    variances_of = entering or _no_sensor_variances
    add_noise = _no_sensor_noise if sensor.noises else sensor_noise(sensor)

    def innovate(
        mean: Floats, covariance: Floats, data: Floats, parameters: Any, use: int, work: Workspace
    ) -> bool:
        memory = work.samples[samples]
        difference, spread, cross = work.innovations[number]
        arguments, variances = (read_about(data), parameters), variances_of(parameters)
        if not regress(mean, covariance, arguments, variances, spread, cross, use, memory):
            return False
        for i in range(m):
            difference[i] = wrap(data[i] - memory.centre[i], angular[i])
        add_noise(spread, data, parameters, work)
        return True

    return innovate


def _measured(sensor: Sensor) -> Function:
    measure = sensor.measure
    if sensor.noises:

        def with_noise(state: Any, noise: Any, arguments: Any) -> Any:
            return measure(state, noise, arguments[0], arguments[1])

        return with_noise

    def without(state: Any, noise: Any, arguments: Any) -> Any:  # noqa: ARG001
        return measure(state, arguments[0], arguments[1])

    return without


def _no_sensor_variances(parameters: Any) -> tuple[float, ...]:  # noqa: ARG001
    return ()


def _no_sensor_noise(spread: Floats, data: Floats, parameters: Any, work: Any) -> None:
    pass
