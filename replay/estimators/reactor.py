"""The batch reactor's filters: a quadratic motion, a linear measurement.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.A and appendix (which prints x_hat where the noise's mean w_hat is meant).
"""

from recorders.models.reactor import CONSUMED, PRODUCED, react
from replay.estimators.discrete import Steps, System
from replay.estimators.gaussian import (
    Floats,
    Innovation,
    SampleMemory,
    regression,
    sample_memory,
)
from replay.sampling.sets import SampleSets

# noise = (step_s, process_variance, pressure_variance)
regress = regression(react, (False, False), states=2)


def predict_sampled(
    mean: Floats, covariance: Floats, noise: Floats, step: int, memory: SampleMemory
) -> bool:
    """Move mean and covariance by statistical linear regression; the noise is additive."""
    if not regress(mean, covariance, (noise[0],), covariance, memory.cross, step, memory):
        return False
    for row in range(2):
        mean[row] = memory.shift[row]
        covariance[row, row] += noise[1]
    return True


def predict_analytic(
    mean: Floats,
    covariance: Floats,
    noise: Floats,
    step: int,  # noqa: ARG001
    memory: SampleMemory,  # noqa: ARG001
) -> bool:
    """Move mean and covariance by their exact moments.

    x' = x + g a^2 with a Gaussian: E a^2 = m^2 + P, Var a^2 = 2 P^2 + 4 m^2 P, Cov(x, a^2) = 2 m P_xa.
    """
    square = mean[0] * mean[0] + covariance[0, 0]
    variance = 2.0 * covariance[0, 0] ** 2 + 4.0 * mean[0] ** 2 * covariance[0, 0]
    gain = (CONSUMED * noise[0], PRODUCED * noise[0])
    cross = (2.0 * mean[0] * covariance[0, 0], 2.0 * mean[0] * covariance[1, 0])
    for row in range(2):
        mean[row] += gain[row] * square
        for column in range(2):
            covariance[row, column] += (cross[row] * gain[column] + gain[row] * cross[column]) + gain[
                row
            ] * gain[column] * variance
        covariance[row, row] += noise[1]
    return True


def innovate(
    mean: Floats,
    covariance: Floats,
    measured: Floats,
    noise: Floats,
    innovation: Innovation,
    step: int,  # noqa: ARG001
    memory: SampleMemory,  # noqa: ARG001
) -> bool:
    """The measured total against the predicted one, and the covariances: the Kalman filter's own."""
    cross = innovation.cross_covariance
    innovation.difference[0] = measured[0] - mean[0] - mean[1]
    for row in range(2):
        cross[row, 0] = covariance[row, 0] + covariance[row, 1]
    innovation.covariance[0, 0] = cross[0, 0] + cross[1, 0] + noise[2]
    return True


def memory_of(noise: Floats, sets: SampleSets) -> SampleMemory:  # noqa: ARG001
    """What a filter works in."""
    return sample_memory(sets, states=2, values=2)


REACTOR = System(
    topic="/pressure",
    column="value",
    reads={"total_pressure": "linear"},
    noise=("step_s", "process_variance", "pressure_variance"),
    measured=("total_pressure",),
    state=("pressure_a", "pressure_b"),
    sampled=2,
    memory=memory_of,
    steps={
        "sampled": Steps(predict_sampled, innovate),
        "analytic": Steps(predict_analytic, innovate),
    },
)
