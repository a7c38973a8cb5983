"""The extended target's filters: a random walk, and a measurement with multiplicative noise.

Sources: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.B; Baum, Faion and Hanebeck, "Modeling the Target Extent with Multiplicative Noise", FUSION
2012. The filters take the scales h as Gaussian, though they are uniform: E h^4 = 1/3.
"""

import numpy as np

from recorders.models.extended_target import SCALE_VARIANCE, quadratic, surface_point
from recorders.models.planar import Component, Components
from replay.estimators.discrete import Steps, System
from replay.estimators.gaussian import (
    Floats,
    Innovation,
    SampleMemory,
    regression,
    sample_memory,
)
from replay.measurements import PLANE
from replay.sampling.sets import SampleSets

STATES = 4
JOINT = 8  # half sides, centre, scales, noise of the point


def measure(joint: Components) -> tuple[Component, Component, Component, Component]:
    """The measurement of a joint vector of target (4), scales (2) and noise of the point (2)."""
    x, y = surface_point(joint, (joint[4], joint[5]))
    return quadratic((x + joint[6], y + joint[7]))


# noise = (size_drift_m2, position_drift_m2, point_variance_m2)
regress = regression(measure, (False,) * 4, states=STATES, noises=4)


def predict(
    mean: Floats,  # noqa: ARG001
    covariance: Floats,
    noise: Floats,
    step: int,  # noqa: ARG001
    memory: SampleMemory,  # noqa: ARG001
) -> bool:
    """One step of the random walk, exactly."""
    for row in range(STATES):
        covariance[row, row] += noise[0] if row < 2 else noise[1]
    return True


def innovate_sampled(
    mean: Floats,
    covariance: Floats,
    measured: Floats,
    noise: Floats,  # noqa: ARG001
    innovation: Innovation,
    step: int,
    memory: SampleMemory,
) -> bool:
    """The moments of the quadratic measurement by regression over state and noise together."""
    _, spread, cross = innovation
    if not regress(mean, covariance, (), spread, cross, step, memory):
        return False
    seen = quadratic(measured)
    for i in range(4):
        innovation.difference[i] = seen[i] - memory.shift[i]
    return True


def memory_of(noise: Floats, sets: SampleSets) -> SampleMemory:
    """What a filter works in: its factor holds the noise that is sampled with the state."""
    memory = sample_memory(sets, states=STATES, values=4)
    sigmas = np.sqrt([SCALE_VARIANCE, SCALE_VARIANCE, noise[2], noise[2]])
    memory.factor[STATES:, STATES:] = np.diag(sigmas)
    return memory


def innovate_analytic(
    mean: Floats,
    covariance: Floats,
    measured: Floats,
    noise: Floats,
    innovation: Innovation,
    step: int,  # noqa: ARG001
    memory: SampleMemory,  # noqa: ARG001
) -> bool:
    """The exact moments of the quadratic measurement y = (m, m^2).

    Given the state, m is Gaussian with mean c and variance v = l^2 / 3 + r in each axis. So Cov(y) is
    the mean of Cov(y | state), where Var m^2 = 2 v^2 + 4 c^2 v and Cov(m, m^2) = 2 c v, plus the
    covariance of E(y | state) = (c, c^2 + v); squares of Gaussians have Cov(s^2, t^2) =
    2 P_st^2 + 4 m_s m_t P_st and Cov(s, t^2) = 2 m_t P_st.
    """
    difference, innovation_covariance, cross_covariance = innovation
    seen = quadratic(measured)
    for i in range(2):
        size, place = i, 2 + i
        variance, with_place, with_square = scatter(mean, covariance, i, noise[2])
        difference[i] = seen[i] - mean[place]
        difference[2 + i] = seen[2 + i] - variance - mean[place] ** 2 - covariance[place, place]
        for row in range(STATES):
            cross_covariance[row, i] = covariance[row, place]
            cross_covariance[row, 2 + i] = 2.0 * (
                SCALE_VARIANCE * mean[size] * covariance[row, size]
                + mean[place] * covariance[row, place]
            )
        for j in range(2):
            innovation_covariance[i, j] = covariance[place, 2 + j]
            innovation_covariance[2 + i, 2 + j] = (
                SCALE_VARIANCE**2 * square_covariance(mean, covariance, size, j)
                + SCALE_VARIANCE * square_covariance(mean, covariance, size, 2 + j)
                + SCALE_VARIANCE * square_covariance(mean, covariance, place, j)
                + square_covariance(mean, covariance, place, 2 + j)
            )
            mixed = cross_covariance[2 + j, 2 + i] + (with_place if i == j else 0.0)
            innovation_covariance[j, 2 + i] = mixed
            innovation_covariance[2 + i, j] = mixed
        innovation_covariance[i, i] += variance
        innovation_covariance[2 + i, 2 + i] += with_square
    return True


def scatter(
    mean: Floats, covariance: Floats, axis: int, point_variance_m2: float
) -> tuple[float, float, float]:
    """The mean over the state of v, 2cv and 2v^2 + 4c^2 v: Var m, Cov(m, m^2) and Var m^2 given it."""
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
    """Cov(s^2, t^2) of two components of a Gaussian."""
    shared = covariance[first, second]
    return 2.0 * shared * shared + 4.0 * mean[first] * mean[second] * shared


EXTENDED_TARGET = System(
    topic="/surface_point",
    column="position_m",
    reads=PLANE,
    noise=("size_drift_m2", "position_drift_m2", "point_variance_m2"),
    measured=("x_m", "y_m", "x_squared_m2", "y_squared_m2"),
    state=("half_x_m", "half_y_m", "x_m", "y_m"),
    sampled=JOINT,
    memory=memory_of,
    steps={
        "sampled": Steps(predict, innovate_sampled),
        "analytic": Steps(predict, innovate_analytic),
    },
)
