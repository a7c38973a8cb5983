"""Model of an extended target: a random walk, measured with multiplicative noise.

Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014, section
VI.B; Baum, Faion and Hanebeck, "Modeling the Target Extent with Multiplicative Noise", FUSION 2012. The
scales h are uniformly distributed. The filters treat them as Gaussian, and therefore use E h^4 = 1/3
instead of 1/5.
"""

from typing import Any

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.families.sampling.extended_target import SCALE_VARIANCE, quadratic, surface_point
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.planar import Components
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters

STATES = 4


class ExtendedTargetParameters(ModelParameters):
    """Variances added per step, and the variance of a measured point.

    Attributes:
        size_drift_m2: variance that a step adds to half the length of each side.
        position_drift_m2: variance that a step adds to the position, per axis.
        point_variance_m2: variance of a measured point, per axis.
    """

    size_drift_m2: NonNegativeFloat | None = None
    position_drift_m2: NonNegativeFloat | None = None
    point_variance_m2: PositiveFloat | None = None


def stay(target: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Return the mean of the random walk after a step."""
    return target[0], target[1], target[2], target[3]


def drift(target: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances that one step of the random walk adds."""
    size, place = parameters.size_drift_m2, parameters.position_drift_m2
    return size, size, place, place


def measure(target: Components, noise: Components, reference: Any, parameters: Any) -> Components:
    """Compute a noisy point from two noisy scales, and append the squares of its coordinates."""
    x, y = surface_point(target, (noise[0], noise[1]))
    return quadratic((x + noise[2], y + noise[3]))


def point_noise(parameters: Any) -> Components:
    """Return the variances of the scales and of the point."""
    variance = parameters.point_variance_m2
    return SCALE_VARIANCE, SCALE_VARIANCE, variance, variance


def read(stream: Stream) -> Floats:
    """Read the pseudo-measurements (n, 4)."""
    return np.stack(quadratic(read_vectors(stream, "position_m", PLANE).T), axis=1)


def moments(
    mean: Floats,
    covariance: Floats,
    reference: Any,
    parameters: Any,
    predicted: Floats,
    spread: Floats,
    cross: Floats,
) -> None:
    """Compute the exact moments of the quadratic measurement y = (m, m^2).

    Given the state, m is Gaussian with mean c and variance v = l^2 / 3 + r in each axis. So Cov(y) is
    the mean of Cov(y | state), where Var m^2 = 2 v^2 + 4 c^2 v and Cov(m, m^2) = 2 c v, plus the
    covariance of E(y | state) = (c, c^2 + v); squares of Gaussians have Cov(s^2, t^2) =
    2 P_st^2 + 4 m_s m_t P_st and Cov(s, t^2) = 2 m_t P_st.

    Args:
        mean, covariance: (4,) and (4, 4), of the state: two half sides l and the centre c, in m.
        reference: not used.
        parameters: parameters with `point_variance_m2`, which is r.
        predicted, spread, cross: E y (4,), Cov(y) (4, 4), Cov(state, y) (4, 4), overwritten.
    """
    for i in range(2):
        size, place = i, 2 + i
        variance, with_place, with_square = scatter(mean, covariance, i, parameters.point_variance_m2)
        predicted[i] = mean[place]
        predicted[2 + i] = variance + mean[place] ** 2 + covariance[place, place]
        for row in range(STATES):
            cross[row, i] = covariance[row, place]
            cross[row, 2 + i] = 2.0 * (
                SCALE_VARIANCE * mean[size] * covariance[row, size]
                + mean[place] * covariance[row, place]
            )
        for j in range(2):
            spread[i, j] = covariance[place, 2 + j]
            spread[2 + i, 2 + j] = (
                SCALE_VARIANCE**2 * square_covariance(mean, covariance, size, j)
                + SCALE_VARIANCE * square_covariance(mean, covariance, size, 2 + j)
                + SCALE_VARIANCE * square_covariance(mean, covariance, place, j)
                + square_covariance(mean, covariance, place, 2 + j)
            )
            mixed = cross[2 + j, 2 + i] + (with_place if i == j else 0.0)
            spread[j, 2 + i] = mixed
            spread[2 + i, j] = mixed
        spread[i, i] += variance
        spread[2 + i, 2 + i] += with_square


def scatter(
    mean: Floats, covariance: Floats, axis: int, point_variance_m2: float
) -> tuple[float, float, float]:
    """Average v, 2cv and 2v^2 + 4c^2 v of one axis over the state's distribution; see `moments`.

    These three quantities are Var m, Cov(m, m^2) and Var m^2 given the state.

    Args:
        mean, covariance: (4,), (4, 4).
        axis: 0 for x, 1 for y.
        point_variance_m2: r.
    """
    size, place = mean[axis], mean[2 + axis]
    own, shared = covariance[axis, axis], covariance[axis, 2 + axis]
    size_square = size**2 + own
    place_square = place**2 + covariance[2 + axis, 2 + axis]
    size_fourth = size**4 + 6.0 * size**2 * own + 3.0 * own**2
    product = place * size_square + 2.0 * size * shared  # E c l^2
    product_square = size_square * place_square + square_covariance(mean, covariance, axis, 2 + axis)
    variance = SCALE_VARIANCE * size_square + point_variance_m2
    variance_square = SCALE_VARIANCE**2 * size_fourth + point_variance_m2 * (
        2.0 * variance - point_variance_m2
    )
    return (
        variance,
        2.0 * (SCALE_VARIANCE * product + point_variance_m2 * place),
        2.0 * variance_square
        + 4.0 * (SCALE_VARIANCE * product_square + point_variance_m2 * place_square),
    )


def square_covariance(mean: Floats, covariance: Floats, first: int, second: int) -> float:
    """Compute Cov(s^2, t^2) of two components of a Gaussian.

    Args:
        mean, covariance: (n,), (n, n).
        first, second: the indices of s and t in the state.
    """
    shared = covariance[first, second]
    return 2.0 * shared * shared + 4.0 * mean[first] * mean[second] * shared


EXTENDED_TARGET = Model(
    "half sides and centre of a rectangle",
    dict.fromkeys(("half_x_m", "half_y_m", "x_m", "y_m"), "linear"),
    ExtendedTargetParameters,
    (
        Sensor(
            "surface_point",
            schemas.POSITION_FIX,
            dict.fromkeys(("x_m", "y_m", "x_squared_m2", "y_squared_m2"), "linear"),
            measure,
            point_noise,
            noises=4,
            read=read,
            moments=moments,
        ),
    ),
    Motion(stay, drift, linear=True),
    system="extended-target",
    takes_fixes=False,
)
