"""What recursive Gaussian filters are made of.

There are two ways to pass a Gaussian through a function: linearisation (extended Kalman filter) and
sampling (linear regression Kalman filters, the UKF first). A filter is a pair of functions, made by
`linearised` or `sampled` from a family's models and compiled with that family's loop. All of it is
scalar loops over small arrays; `mean` (n,) and `covariance` (n, n) are changed in place, and stay
symmetric by construction.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput

Floats = NDArray[np.float64]
Function = Callable[..., Any]


class Models(NamedTuple):
    """A family's component-first models, and their Jacobians as functions that fill arrays.

    Attributes:
        motion: (state, control, duration_s) -> the next state, a tuple.
        motion_jacobians: (state, control, duration_s, transition, gain) fills the Jacobians by the
            state (n, n) and by the control (n, controls).
        sensor: (state, target) -> all components that the sensor can measure, a tuple.
        sensor_jacobian: (state, target, rows) fills the Jacobian by the state (components, n).
        angular: for every component of the sensor, whether it is an angle.
    """

    motion: Function
    motion_jacobians: Function
    sensor: Function
    sensor_jacobian: Function
    angular: tuple[bool, ...]


class Filter(NamedTuple):
    """The steps of a recursive Gaussian filter, before the Kalman update that `correct` does.

    predict(mean, covariance, control, control_variance, duration_s, points, weights): moves mean and
    covariance; False where the covariance is not positive definite.
    innovate(mean, covariance, target, measured, variance, points, weights, innovation,
    innovation_covariance, cross_covariance): fills the last three for the components that `measured`
    has (NaN where it has none); how many these are, or -1 where the covariance is not positive definite.
    """

    predict: Function
    innovate: Function


def cholesky(factor: Floats, matrix: Floats, size: int) -> bool:
    """Fill the lower factor of the leading block; False where it is not positive definite (or NaN)."""
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
    return (difference + np.pi) % (2.0 * np.pi) - np.pi if is_angle else difference


def correct(
    mean: Floats,
    covariance: Floats,
    innovation: Floats,
    innovation_covariance: Floats,
    cross_covariance: Floats,
    size: int,
    gate: Floats,
) -> tuple[float, bool]:
    """The Kalman update by an innovation v (size,): x + K v and P - K S K', unless the gate is shut.

    `gate` (components + 1,) bounds the normalised innovation squared by the number of components.
    Returns that number's value, NaN where S is not positive definite, and whether the update was made.
    """
    states = len(mean)
    factor = np.empty((size, size))
    if not cholesky(factor, innovation_covariance, size):
        return np.nan, False
    whitened = np.empty(size)
    squared = 0.0
    for i in range(size):
        entry = innovation[i]
        for k in range(i):
            entry -= factor[i, k] * whitened[k]
        whitened[i] = entry / factor[i, i]
        squared += whitened[i] * whitened[i]
    if not squared <= gate[size]:
        return squared, False
    # W = C L^-T, so that K v = W L^-1 v and K S K' = W W'
    half_gain = np.empty((states, size))
    for row in range(states):
        for i in range(size):
            entry = cross_covariance[row, i]
            for k in range(i):
                entry -= factor[i, k] * half_gain[row, k]
            half_gain[row, i] = entry / factor[i, i]
    for row in range(states):
        for i in range(size):
            mean[row] += half_gain[row, i] * whitened[i]
        for column in range(row + 1):
            entry = covariance[row, column]
            for i in range(size):
                entry -= half_gain[row, i] * half_gain[column, i]
            covariance[row, column] = entry
            covariance[column, row] = entry
    return squared, True


def linearised(models: Models) -> Filter:
    """The extended Kalman filter: first-order Taylor expansion at the mean."""
    motion, motion_jacobians, sensor, sensor_jacobian, angular = models

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        control_variance: Floats,
        duration_s: float,
        points: Floats,  # noqa: ARG001
        weights: Floats,  # noqa: ARG001
    ) -> bool:
        size = len(mean)
        transition = np.empty((size, size))
        gain = np.empty((size, len(control)))
        motion_jacobians(mean, control, duration_s, transition, gain)
        moved = motion(mean, control, duration_s)
        spread = np.zeros((size, size))
        for row in range(size):
            mean[row] = moved[row]
            for k in range(size):
                for column in range(size):
                    spread[row, column] += transition[row, k] * covariance[k, column]
        for row in range(size):
            for column in range(row + 1):
                entry = 0.0
                for k in range(size):
                    entry += spread[row, k] * transition[column, k]
                for k in range(len(control)):
                    entry += gain[row, k] * control_variance[k] * gain[column, k]
                covariance[row, column] = entry
                covariance[column, row] = entry
        return True

    def innovate(
        mean: Floats,
        covariance: Floats,
        target: Floats,
        measured: Floats,
        variance: Floats,
        points: Floats,  # noqa: ARG001
        weights: Floats,  # noqa: ARG001
        innovation: Floats,
        innovation_covariance: Floats,
        cross_covariance: Floats,
    ) -> int:
        states = len(mean)
        predicted = sensor(mean, target)
        rows = np.empty((len(measured), states))
        sensor_jacobian(mean, target, rows)
        used = 0
        for component in range(len(measured)):
            if np.isnan(measured[component]):
                continue
            innovation[used] = wrap(measured[component] - predicted[component], angular[component])
            for row in range(states):
                entry = 0.0
                for k in range(states):
                    entry += covariance[row, k] * rows[component, k]
                cross_covariance[row, used] = entry
            for k in range(states):
                rows[used, k] = rows[component, k]
            for other in range(used + 1):
                entry = 0.0
                for k in range(states):
                    entry += rows[other, k] * cross_covariance[k, used]
                innovation_covariance[used, other] = entry
                innovation_covariance[other, used] = entry
            innovation_covariance[used, used] += variance[component]
            used += 1
        return used

    return Filter(predict, innovate)


def sampled(models: Models) -> Filter:
    """A linear regression Kalman filter: moments of the function at samples of the Gaussian.

    The samples are `points` (L, n) with `weights` (L,), of zero mean and unit covariance, moved to mean
    and covariance by its Cholesky factor. Values are taken as differences from the value at the mean,
    so that angles need no mean of their own. The motion noise enters by the control's Jacobian.
    """
    motion, motion_jacobians, sensor, _, angular = models

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        control_variance: Floats,
        duration_s: float,
        points: Floats,
        weights: Floats,
    ) -> bool:
        size = len(mean)
        factor = np.empty((size, size))
        if not cholesky(factor, covariance, size):
            return False
        gain = np.empty((size, len(control)))
        motion_jacobians(mean, control, duration_s, np.empty((size, size)), gain)
        centre = motion(mean, control, duration_s)
        sample = np.empty(size)
        moved = np.empty((len(weights), size))
        shift = np.zeros(size)
        for index in range(len(weights)):
            for row in range(size):
                sample[row] = mean[row]
                for k in range(row + 1):
                    sample[row] += factor[row, k] * points[index, k]
            value = motion(sample, control, duration_s)
            for row in range(size):
                moved[index, row] = value[row] - centre[row]
                shift[row] += weights[index] * moved[index, row]
        for row in range(size):
            mean[row] = centre[row] + shift[row]
            for column in range(row + 1):
                entry = 0.0
                for index in range(len(weights)):
                    entry += (
                        weights[index]
                        * (moved[index, row] - shift[row])
                        * (moved[index, column] - shift[column])
                    )
                for k in range(len(control)):
                    entry += gain[row, k] * control_variance[k] * gain[column, k]
                covariance[row, column] = entry
                covariance[column, row] = entry
        return True

    def innovate(
        mean: Floats,
        covariance: Floats,
        target: Floats,
        measured: Floats,
        variance: Floats,
        points: Floats,
        weights: Floats,
        innovation: Floats,
        innovation_covariance: Floats,
        cross_covariance: Floats,
    ) -> int:
        size = len(mean)
        factor = np.empty((size, size))
        if not cholesky(factor, covariance, size):
            return -1
        centre = sensor(mean, target)
        offset = np.empty((len(weights), size))
        seen = np.empty((len(weights), len(measured)))
        shift = np.zeros(len(measured))
        sample = np.empty(size)
        for index in range(len(weights)):
            for row in range(size):
                offset[index, row] = 0.0
                for k in range(row + 1):
                    offset[index, row] += factor[row, k] * points[index, k]
                sample[row] = mean[row] + offset[index, row]
            value = sensor(sample, target)
            used = 0
            for component in range(len(measured)):
                if not np.isnan(measured[component]):
                    seen[index, used] = wrap(value[component] - centre[component], angular[component])
                    shift[used] += weights[index] * seen[index, used]
                    used += 1
        used = 0
        for component in range(len(measured)):
            if np.isnan(measured[component]):
                continue
            residual = measured[component] - centre[component] - shift[used]
            innovation[used] = wrap(residual, angular[component])
            for row in range(size):
                entry = 0.0
                for index in range(len(weights)):
                    entry += weights[index] * offset[index, row] * (seen[index, used] - shift[used])
                cross_covariance[row, used] = entry
            for other in range(used + 1):
                entry = 0.0
                for index in range(len(weights)):
                    entry += (
                        weights[index]
                        * (seen[index, used] - shift[used])
                        * (seen[index, other] - shift[other])
                    )
                innovation_covariance[used, other] = entry
                innovation_covariance[other, used] = entry
            innovation_covariance[used, used] += variance[component]
            used += 1
        return used

    return Filter(predict, innovate)


def unscented_points(dimension: int, kappa: float) -> tuple[Floats, Floats]:
    """The unscented samples of N(0, I): points (2n + 1, n), the centre first, and weights (2n + 1,).

    Julier and Uhlmann: radius sqrt(n + kappa), centre weight kappa / (n + kappa).
    Raises BadInput unless n + kappa is positive.
    """
    spread = dimension + kappa
    if not spread > 0:
        raise BadInput(f"kappa = {kappa}: dimension + kappa must be positive, here above {-dimension}")
    axes = np.sqrt(spread) * np.eye(dimension)
    points = np.concatenate([np.zeros((1, dimension)), axes, -axes])
    weights = np.full(2 * dimension + 1, 0.5 / spread)
    weights[0] = kappa / spread
    return points, weights
