"""Frozen reference: what the hand-specialised Gaussian filters of landmarks and reactor are made of.

As it was before filters were made from models (issue 13), to be timed against and for nothing else: no
estimator uses it. Scalar loops over small arrays that are changed in place.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Function = Callable[..., Any]
ALL_WELL, NOT_POSITIVE_DEFINITE, NOT_FINITE = -1, 0, 1


class SampleSets(NamedTuple):
    """Points (sets, L, N) and weights (sets, L); use number u takes the set (u - first) * stride."""

    points: Floats
    weights: Floats
    first: int
    stride: int


def wrap_angle(angle: float) -> float:
    """The equal angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


class Models(NamedTuple):
    """A family's component-first models, and their Jacobians as functions that fill arrays.

    Attributes:
        states: n, how many components the state has.
        motion: (state, control, duration_s) -> the next state, a tuple; it does not wrap angles.
        motion_jacobians: (state, control, duration_s, transition, gain) fills the Jacobians by the
            state (n, n) and by the control (n, controls).
        sensor: (state, target) -> all m components that the sensor can measure, a tuple.
        sensor_jacobian: (state, target, rows) fills the Jacobian by the state (m, n).
        angular: for every component of the sensor, whether it is an angle.
    """

    states: int
    motion: Function
    motion_jacobians: Function
    sensor: Function
    sensor_jacobian: Function
    angular: tuple[bool, ...]


class Innovation(NamedTuple):
    """How a measurement differs from its prediction.

    Attributes:
        difference: v (m,), NaN where the measurement has no such component.
        covariance: S (m, m), of v.
        cross_covariance: C (n, m), of the state with v.
    """

    difference: Floats
    covariance: Floats
    cross_covariance: Floats


def no_innovation(states: int, components: int) -> Innovation:
    """Memory for an innovation."""
    return Innovation(
        np.empty(components), np.empty((components, components)), np.empty((states, components))
    )


class Filter(NamedTuple):
    """The steps of a recursive Gaussian filter, before the Kalman update that `correct` does.

    Attributes:
        memory: (states, controls, components, sets) -> what the other two work in.
        predict: (mean, covariance, control, control_density, duration_s, event, memory) moves mean (n,)
            and covariance (n, n) in place; the control's noise density is per square root of a second.
        innovate: (mean, covariance, target, measured, variance, innovation, event, memory) fills an
            `Innovation`; `measured` (m,) is NaN where it has no such component.

    The event's number tells a randomised sampling which samples to take. The steps return False where
    the covariance is not positive definite.
    """

    memory: Function
    predict: Function
    innovate: Function


def cholesky(factor: Floats, matrix: Floats, size: int) -> bool:
    """Fill the lower factor of the leading block; False where it is not positive definite (or NaN).

    Both arguments may be the same array.
    """
    for column in range(size):
        for row in range(column, size):
            entry = matrix[row, column]
            for k in range(column):
                entry -= factor[row, k] * factor[column, k]
            if row > column:
                factor[row, column] = entry / factor[column, column]
            elif entry > 0.0:
                factor[row, row] = np.sqrt(entry)
            else:
                return False
    return True


def wrap(difference: float, is_angle: bool) -> float:
    """The difference, in [-pi, pi) where it is one of angles."""
    if is_angle and not abs(difference) < np.pi:
        return wrap_angle(difference)
    return difference


def correct(
    mean: Floats, covariance: Floats, innovation: Innovation, gate: Floats
) -> tuple[float, bool]:
    """The Kalman update: x + K v and P - K S K' with K = C S^-1, unless the gate is shut.

    `gate` (m + 1,) bounds the normalised innovation squared v' S^-1 v by the number of components.
    Returns that number, NaN where S is not positive definite, and whether the update was made. The
    innovation is used up: its arrays are left as scratch.
    """
    difference, factor, cross = innovation
    size = keep_measured(innovation)
    if not cholesky(factor, factor, size):
        return np.nan, False
    squared = 0.0
    for i in range(size):  # v becomes L^-1 v
        entry = difference[i]
        for k in range(i):
            entry -= factor[i, k] * difference[k]
        difference[i] = entry / factor[i, i]
        squared += difference[i] * difference[i]
    if not squared <= gate[size]:
        return squared, False
    for row in range(len(mean)):  # C becomes W = C L^-T, so that K v = W L^-1 v and K S K' = W W'
        for i in range(size):
            entry = cross[row, i]
            for k in range(i):
                entry -= factor[i, k] * cross[row, k]
            cross[row, i] = entry / factor[i, i]
            mean[row] += cross[row, i] * difference[i]
        for column in range(row + 1):
            entry = covariance[row, column]
            for i in range(size):
                entry -= cross[row, i] * cross[column, i]
            covariance[row, column] = covariance[column, row] = entry
    return squared, True


def keep_measured(innovation: Innovation) -> int:
    """Move the components that were measured to the front; returns how many there are."""
    difference, covariance, cross_covariance = innovation
    size = 0
    for component in range(len(difference)):
        if np.isnan(difference[component]):
            continue
        difference[size] = difference[component]
        for row in range(len(cross_covariance)):
            cross_covariance[row, size] = cross_covariance[row, component]
        for k in range(len(difference)):
            covariance[size, k] = covariance[component, k]
        for k in range(len(difference)):
            covariance[k, size] = covariance[k, component]
        size += 1
    return size


def add_control_noise(
    covariance: Floats, gain: Floats, control_density: Floats, duration_s: float
) -> None:
    """Add the noise that the control puts into the state; `gain` G is (n, controls).

    The control carries white noise: its mean over a time T has variance density^2 / T.
    """
    for row in range(len(covariance)):
        for column in range(row + 1):
            entry = covariance[row, column]
            for k in range(len(control_density)):
                variance = control_density[k] * control_density[k] / duration_s
                entry += gain[row, k] * variance * gain[column, k]
            covariance[row, column] = covariance[column, row] = entry


def is_finite(mean: Floats, covariance: Floats) -> bool:
    """Whether a Gaussian holds neither NaN nor infinity."""
    total = 0.0
    for row in range(len(mean)):
        total += mean[row]
        for column in range(row + 1):
            total += covariance[row, column]
    return np.isfinite(total)


class LinearMemory(NamedTuple):
    """What `linearised` works in."""

    transition: Floats
    product: Floats
    gain: Floats
    rows: Floats


def linearised(models: Models) -> Filter:
    """The extended Kalman filter: first-order Taylor expansion at the mean."""
    _, motion, motion_jacobians, sensor, sensor_jacobian, angular = models

    def memory(
        states: int,
        controls: int,
        components: int,
        sets: SampleSets,
    ) -> LinearMemory:
        return LinearMemory(
            transition=np.empty((states, states)),
            product=np.empty((states, states)),
            gain=np.empty((states, controls)),
            rows=np.empty((components, states)),
        )

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        control_density: Floats,
        duration_s: float,
        event: int,
        memory: LinearMemory,
    ) -> bool:
        transition, product, gain = memory.transition, memory.product, memory.gain
        motion_jacobians(mean, control, duration_s, transition, gain)
        moved = motion(mean, control, duration_s)
        size = len(mean)
        for row in range(size):
            mean[row] = moved[row]
            for column in range(size):
                product[row, column] = 0.0
                for k in range(size):
                    product[row, column] += transition[row, k] * covariance[k, column]
        for row in range(size):
            for column in range(row + 1):
                entry = 0.0
                for k in range(size):
                    entry += product[row, k] * transition[column, k]
                covariance[row, column] = covariance[column, row] = entry
        add_control_noise(covariance, gain, control_density, duration_s)
        return True

    def innovate(
        mean: Floats,
        covariance: Floats,
        target: Floats,
        measured: Floats,
        variance: Floats,
        innovation: Innovation,
        event: int,
        memory: LinearMemory,
    ) -> bool:
        difference, innovation_covariance, cross_covariance = innovation
        rows = memory.rows
        sensor_jacobian(mean, target, rows)
        predicted = sensor(mean, target)
        for i in range(len(measured)):
            difference[i] = wrap(measured[i] - predicted[i], angular[i])
            for row in range(len(mean)):
                cross_covariance[row, i] = 0.0
                for k in range(len(mean)):
                    cross_covariance[row, i] += covariance[row, k] * rows[i, k]
            for j in range(i + 1):
                entry = variance[i] if i == j else 0.0
                for k in range(len(mean)):
                    entry += rows[j, k] * cross_covariance[k, i]
                innovation_covariance[i, j] = innovation_covariance[j, i] = entry
        return True

    return Filter(memory, predict, innovate)


class SampleMemory(NamedTuple):
    """Samples of N(0, I), and what a regression at them works in.

    Attributes:
        points, weights, first, stride: see `fuselog.replay.inference.sampling.sets.SampleSets`.
        factor: (N, N) lower factor of the covariance of state (n) and noise (N - n): the state's block
            is filled in, the noise's is given, the rest is zero.
        gain: (n, controls), of control noise.
        offsets: (N, L) the samples' distances from the mean.
        sample: (N,).
        values, shift: (m, L) and (m,), of the function's values.
        cross: (n, m), for a covariance that is not needed.
    """

    points: Floats
    weights: Floats
    first: int
    stride: int
    factor: Floats
    gain: Floats
    offsets: Floats
    sample: Floats
    values: Floats
    shift: Floats
    cross: Floats


def sample_memory(sets: SampleSets, states: int, values: int, controls: int = 0) -> SampleMemory:
    """Memory for regressions with up to so many values; the noise's part of the factor is zero."""
    _, count, dimension = sets.points.shape
    return SampleMemory(
        *sets,
        factor=np.zeros((dimension, dimension)),
        gain=np.empty((states, controls)),
        offsets=np.empty((dimension, count)),
        sample=np.empty(dimension),
        values=np.empty((values, count)),
        shift=np.empty(values),
        cross=np.empty((states, values)),
    )


def regression(function: Function, angular: tuple[bool, ...], states: int, noises: int = 0) -> Function:
    """Statistical linear regression of a component-first `function(z, *arguments)`.

    Its z is the state (n,) and after it the noise, of zero mean, that enters other than by addition.
    The kernel takes the samples of use number `use`, moves them by mean and covariance, and fills the
    mean of the values, `memory.shift`, their covariance (m, m) and their covariance (n, m) with the
    state; False where the state's covariance is not positive definite. Values that are `angular` need
    no mean of their own: all count as differences from the value at the mean.

    Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF
    2014, (19)-(24); (24) prints y_{k,i} where the noise sample is meant.
    """
    size, values = states + noises, len(angular)  # constants, so that the loops over them are unrolled

    def spread(covariance: Floats, points: Floats, memory: SampleMemory) -> bool:
        factor, offsets = memory.factor, memory.offsets
        if not cholesky(factor, covariance, states):
            return False
        for row in range(size):
            for index in range(len(points)):
                entry = 0.0
                for k in range(row + 1):
                    entry += factor[row, k] * points[index, k]
                offsets[row, index] = entry
        return True

    def evaluate(mean: Floats, arguments: tuple[Any, ...], memory: SampleMemory) -> None:
        sample, offsets, changes = memory.sample, memory.offsets, memory.values
        for row in range(size):
            sample[row] = mean[row] if row < states else 0.0
        centre = function(sample, *arguments)
        for index in range(offsets.shape[1]):
            for row in range(states):
                sample[row] = mean[row] + offsets[row, index]
            for row in range(states, size):
                sample[row] = offsets[row, index]
            value = function(sample, *arguments)
            for i in range(values):
                changes[i, index] = wrap(value[i] - centre[i], angular[i])
        for i in range(values):
            memory.shift[i] = centre[i]

    def moments(
        weights: Floats, memory: SampleMemory, covariance: Floats, cross_covariance: Floats
    ) -> None:
        changes, offsets = memory.values, memory.offsets
        for i in range(values):
            shift = weighted_sum(weights, changes[i])
            memory.shift[i] += shift
            for index in range(len(weights)):
                changes[i, index] -= shift
            for j in range(i + 1):
                covariance[i, j] = covariance[j, i] = weighted_product(weights, changes[i], changes[j])
            for row in range(states):
                cross_covariance[row, i] = weighted_product(weights, offsets[row], changes[i])

    def regress(
        mean: Floats,
        covariance: Floats,
        arguments: tuple[Any, ...],
        value_covariance: Floats,
        cross_covariance: Floats,
        use: int,
        memory: SampleMemory,
    ) -> bool:
        chosen = (use - memory.first) * memory.stride
        if not spread(covariance, memory.points[chosen], memory):
            return False
        evaluate(mean, arguments, memory)
        moments(memory.weights[chosen], memory, value_covariance, cross_covariance)
        return True

    return regress


def weighted_sum(weights: Floats, values: Floats) -> float:
    """Sum of products, by four partial sums: one addition need not wait for the one before."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = len(weights) - len(weights) % 4
    for k in range(0, whole, 4):
        a += weights[k] * values[k]
        b += weights[k + 1] * values[k + 1]
        c += weights[k + 2] * values[k + 2]
        d += weights[k + 3] * values[k + 3]
    for k in range(whole, len(weights)):
        a += weights[k] * values[k]
    return (a + b) + (c + d)


def weighted_product(weights: Floats, first: Floats, second: Floats) -> float:
    """Sum of products of three; see `weighted_sum`."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = len(weights) - len(weights) % 4
    for k in range(0, whole, 4):
        a += weights[k] * first[k] * second[k]
        b += weights[k + 1] * first[k + 1] * second[k + 1]
        c += weights[k + 2] * first[k + 2] * second[k + 2]
        d += weights[k + 3] * first[k + 3] * second[k + 3]
    for k in range(whole, len(weights)):
        a += weights[k] * first[k] * second[k]
    return (a + b) + (c + d)


def sampled(models: Models) -> Filter:
    """A linear regression Kalman filter, with whatever samples; see `regression`.

    An event has two uses of samples, prediction and update. The motion noise enters by the control's
    Jacobian, the sensor's by addition.
    """
    states, motion, motion_jacobians, sensor, _, angular = models
    regress_motion = regression(motion, (False,) * states, states)
    regress_sensor = regression(sensor, angular, states)

    def memory(states: int, controls: int, components: int, sets: SampleSets) -> SampleMemory:
        return sample_memory(sets, states, max(states, components), controls)

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        control_density: Floats,
        duration_s: float,
        event: int,
        memory: SampleMemory,
    ) -> bool:
        arguments, cross = (control, duration_s), memory.cross
        if not regress_motion(mean, covariance, arguments, covariance, cross, 2 * event, memory):
            return False
        motion_jacobians(mean, control, duration_s, memory.factor, memory.gain)  # the factor is used up
        add_control_noise(covariance, memory.gain, control_density, duration_s)
        for row in range(len(mean)):
            mean[row] = memory.shift[row]
        return True

    def innovate(
        mean: Floats,
        covariance: Floats,
        target: Floats,
        measured: Floats,
        variance: Floats,
        innovation: Innovation,
        event: int,
        memory: SampleMemory,
    ) -> bool:
        _, spread, cross = innovation
        if not regress_sensor(mean, covariance, (target,), spread, cross, 2 * event + 1, memory):
            return False
        for i in range(len(measured)):
            innovation.difference[i] = wrap(measured[i] - memory.shift[i], angular[i])
            innovation.covariance[i, i] += variance[i]
        return True

    return Filter(memory, predict, innovate)


def unscented(dimension: int, kappa: float) -> SampleSets:
    """The UKF's 2N + 1 samples of N(0, I) for every use."""
    reach = np.sqrt(dimension + kappa)
    axes = np.eye(dimension)
    weights = np.full(2 * dimension + 1, 0.5 / (dimension + kappa))
    weights[0] = kappa / (dimension + kappa)
    points = np.concatenate([np.zeros((1, dimension)), reach * axes, -reach * axes])
    return SampleSets(points[None], weights[None], 0, 0)
