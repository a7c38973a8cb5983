"""What recursive Gaussian filters are made of.

There are two ways to pass a Gaussian through a function: linearisation (extended Kalman filter) and
sampling (linear regression Kalman filters, the UKF first). A filter is made by `linearised` or `sampled`
from a family's models and compiled with that family's loop. All of it is scalar loops over small arrays
that are changed in place, in memory made once per core; covariances stay symmetric by construction.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.models.planar import wrap_angle

Floats = NDArray[np.float64]
Function = Callable[..., Any]


class Models(NamedTuple):
    """A family's component-first models, and their Jacobians as functions that fill arrays.

    Attributes:
        motion: (state, control, duration_s) -> the next state, a tuple; it does not wrap angles.
        motion_jacobians: (state, control, duration_s, transition, gain) fills the Jacobians by the
            state (n, n) and by the control (n, controls).
        sensor: (state, target) -> all m components that the sensor can measure, a tuple.
        sensor_jacobian: (state, target, rows) fills the Jacobian by the state (m, n).
        angular: for every component of the sensor, whether it is an angle.
    """

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
        memory: (states, controls, components, *samples) -> what the other two work in.
        predict: (mean, covariance, control, control_density, duration_s, memory) moves mean (n,) and
            covariance (n, n) in place; the control's noise density is per square root of a second.
        innovate: (mean, covariance, target, measured, variance, innovation, memory) fills an
            `Innovation`; `measured` (m,) is NaN where it has no such component.

    The steps return False where the covariance is not positive definite.
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
    motion, motion_jacobians, sensor, sensor_jacobian, angular = models

    def memory(states: int, controls: int, components: int) -> LinearMemory:
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


def spread(offsets: Floats, factor: Floats, covariance: Floats, points: Floats) -> bool:
    """Fill the samples' offsets (L, n) from the mean; False where P is not positive definite."""
    if not cholesky(factor, covariance, len(covariance)):
        return False
    for index in range(len(points)):
        for row in range(len(covariance)):
            offsets[index, row] = 0.0
            for k in range(row + 1):
                offsets[index, row] += factor[row, k] * points[index, k]
    return True


def moments(shift: Floats, covariance: Floats, values: Floats, weights: Floats) -> None:
    """Fill mean and covariance (d, d) of the first d columns of the values, and centre these."""
    for row in range(len(covariance)):
        shift[row] = 0.0
        for index in range(len(weights)):
            shift[row] += weights[index] * values[index, row]
        for index in range(len(weights)):
            values[index, row] -= shift[row]
        for column in range(row + 1):
            entry = 0.0
            for index in range(len(weights)):
                entry += weights[index] * values[index, row] * values[index, column]
            covariance[row, column] = covariance[column, row] = entry


class SampleMemory(NamedTuple):
    """What `sampled` works in, beside the samples (L, n) and their weights (L,)."""

    points: Floats
    weights: Floats
    factor: Floats
    gain: Floats
    offsets: Floats
    sample: Floats
    values: Floats
    shift: Floats


def sampled(models: Models) -> Filter:
    """A linear regression Kalman filter: moments of the function at samples of the Gaussian.

    The samples are `points` (L, n) with `weights` (L,), of zero mean and unit covariance, moved to mean
    and covariance by its Cholesky factor. Values are taken as differences from the value at the mean,
    so that angles need no mean of their own. The motion noise enters by the control's Jacobian.
    """
    motion, motion_jacobians, sensor, _, angular = models

    def memory(
        states: int, controls: int, components: int, points: Floats, weights: Floats
    ) -> SampleMemory:
        columns = max(states, components)
        return SampleMemory(
            points=points,
            weights=weights,
            factor=np.empty((states, states)),
            gain=np.empty((states, controls)),
            offsets=np.empty((len(points), states)),
            sample=np.empty(states),
            values=np.empty((len(points), columns)),
            shift=np.empty(columns),
        )

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        control_density: Floats,
        duration_s: float,
        memory: SampleMemory,
    ) -> bool:
        points, weights, factor, gain, offsets, sample, values, shift = memory
        if not spread(offsets, factor, covariance, points):
            return False
        motion_jacobians(mean, control, duration_s, factor, gain)  # the factor is used up
        centre = motion(mean, control, duration_s)
        for index in range(len(offsets)):
            for row in range(len(mean)):
                sample[row] = mean[row] + offsets[index, row]
            moved = motion(sample, control, duration_s)
            for row in range(len(mean)):
                values[index, row] = moved[row] - centre[row]
        moments(shift, covariance, values, weights)
        add_control_noise(covariance, gain, control_density, duration_s)
        for row in range(len(mean)):
            mean[row] = centre[row] + shift[row]
        return True

    def innovate(
        mean: Floats,
        covariance: Floats,
        target: Floats,
        measured: Floats,
        variance: Floats,
        innovation: Innovation,
        memory: SampleMemory,
    ) -> bool:
        points, weights, factor, _, offsets, sample, values, shift = memory
        difference, innovation_covariance, cross_covariance = innovation
        if not spread(offsets, factor, covariance, points):
            return False
        centre = sensor(mean, target)
        for index in range(len(offsets)):
            for row in range(len(mean)):
                sample[row] = mean[row] + offsets[index, row]
            seen = sensor(sample, target)
            for i in range(len(measured)):
                values[index, i] = wrap(seen[i] - centre[i], angular[i])
        moments(shift, innovation_covariance, values, weights)
        for i in range(len(measured)):
            difference[i] = wrap(measured[i] - centre[i] - shift[i], angular[i])
            innovation_covariance[i, i] += variance[i]
            for row in range(len(mean)):
                cross_covariance[row, i] = 0.0
                for index in range(len(weights)):
                    cross_covariance[row, i] += weights[index] * offsets[index, row] * values[index, i]
        return True

    return Filter(memory, predict, innovate)


def unscented_points(dimension: int, kappa: float) -> tuple[Floats, Floats]:
    """The unscented samples of N(0, I): points (2n + 1, n), the centre first, and weights (2n + 1,).

    Julier and Uhlmann: radius sqrt(n + kappa), centre weight kappa / (n + kappa).
    Raises BadInput unless n + kappa is positive.
    """
    scale = dimension + kappa
    if not scale > 0:
        raise BadInput(f"kappa = {kappa}: dimension + kappa must be positive, here above {-dimension}")
    axes = np.sqrt(scale) * np.eye(dimension)
    points = np.concatenate([np.zeros((1, dimension)), axes, -axes])
    weights = np.full(2 * dimension + 1, 0.5 / scale)
    weights[0] = kappa / scale
    return points, weights
