"""Model of a batch reactor, with a quadratic motion and a linear measurement.

Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014, section
VI.A and appendix (which prints x_hat instead of the noise's mean w_hat). Time is discrete: every
measurement is one step of `step_s`.
"""

from typing import Any

from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.families.sampling.reactor import CONSUMED, PRODUCED, react, total_pressure
from fuselog.recorders.log import schemas
from fuselog.recorders.models.planar import Components
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters


class ReactorParameters(ModelParameters):
    """Time step, and variances per step.

    Attributes:
        step_s: length of a time step.
        process_variance: variance that a step adds to each partial pressure, in the square of its unit.
        pressure_variance: variance of a measured total pressure, in the square of its unit.
    """

    step_s: PositiveFloat | None = None
    process_variance: NonNegativeFloat | None = None
    pressure_variance: PositiveFloat | None = None


def move(pressures: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Advance the reaction by one step."""
    return react(pressures, parameters.step_s)


def process_noise(pressures: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variance of each pressure's noise in a step."""
    return parameters.process_variance, parameters.process_variance


def moments(
    mean: Floats,
    covariance: Floats,
    control: Any,
    duration_s: Any,
    parameters: Any,
) -> None:
    """Predict mean and covariance exactly.

    x' = x + g a^2, where a is Gaussian: E a^2 = m^2 + P, Var a^2 = 2 P^2 + 4 m^2 P, Cov(x, a^2) = 2 m
    P_xa.

    Args:
        mean, covariance: (2,) and (2, 2), of both partial pressures, changed in place.
        control, duration_s: not used: every step is `parameters.step_s` long.
        parameters: parameters with `step_s`.
    """
    square = mean[0] * mean[0] + covariance[0, 0]
    variance = 2.0 * covariance[0, 0] ** 2 + 4.0 * mean[0] ** 2 * covariance[0, 0]
    gain = (CONSUMED * parameters.step_s, PRODUCED * parameters.step_s)
    cross = (2.0 * mean[0] * covariance[0, 0], 2.0 * mean[0] * covariance[1, 0])
    for row in range(2):
        mean[row] += gain[row] * square
        for column in range(2):
            mixed = cross[row] * gain[column] + gain[row] * cross[column]
            covariance[row, column] += mixed + gain[row] * gain[column] * variance


def read(pressures: Components, reference: Any, parameters: Any) -> Components:
    """Compute the reading of the sensor."""
    return total_pressure(pressures)


def reading_noise(parameters: Any) -> Components:
    """Return the variance of a reading."""
    return (parameters.pressure_variance,)


REACTOR = Model(
    "partial pressures in a batch reactor",
    {"pressure_a": "linear", "pressure_b": "linear"},
    ReactorParameters,
    (
        Sensor(
            "pressure",
            schemas.VECTOR_MEASUREMENT,
            {"total_pressure": "linear"},
            read,
            reading_noise,
            vector="value",
            linear=True,
        ),
    ),
    Motion(move, process_noise, moments=moments),
    system="batch-reactor",
)
