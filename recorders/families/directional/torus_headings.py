"""Two coupled headings, and correlated measurements of both, modulo 2 pi.

x+ = x + c (cos x2, sin x1) + drift + w and z = x + v: the system of Kurz and Hanebeck, "Deterministic
Sampling on the Torus for Bivariate Circular Estimation", 2016, section IV, with noise. The measurements'
channel states the model.
"""

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import prior_stream, truth_stream
from fuselog.recorders.families.directional.headings import Correlation, equal_sigmas, turn_together
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.models.states import state_metadata
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

HEADINGS = ("heading1_rad", "heading2_rad")


class HeadingsParameters(Parameters):
    """Two coupled headings and their measurements.

    Attributes:
        steps: number of time steps.
        step_s: length of a time step.
        coupling_rad: in each step, the first heading turns by this angle times the cosine of the second,
            and the second by this angle times the sine of the first.
        drift1_rad: additional turn of the first heading per step.
        drift2_rad: additional turn of the second heading per step.
        system_sigma_rad: standard deviation of a heading's noise per step.
        system_correlation: correlation of the two headings' noises.
        measurement_sigma_rad: standard deviation of a measured heading.
        measurement_correlation: correlation of the two measured headings' errors.
        prior_sigma_rad: standard deviation of a heading at the start.
    """

    steps: PositiveInt = 50
    step_s: PositiveFloat = 0.1
    coupling_rad: float = 0.1
    drift1_rad: float = 0.3
    drift2_rad: float = -0.2
    system_sigma_rad: PositiveFloat = 0.2
    system_correlation: Correlation = 0.8
    measurement_sigma_rad: PositiveFloat = 0.8
    measurement_correlation: Correlation = 0.5
    prior_sigma_rad: PositiveFloat = 1.0

    def covariances(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the covariances of system and measurement noise, (2, 2), rad^2."""
        return (
            equal_sigmas(self.system_sigma_rad, self.system_correlation),
            equal_sigmas(self.measurement_sigma_rad, self.measurement_correlation),
        )


def simulate(parameters: HeadingsParameters, rng: np.random.Generator) -> Recording:
    """Record one run: prior, truth after every step, and its measurement in [0, 2 pi)."""
    system, measurement = parameters.covariances()
    system_noise = rng.multivariate_normal((0.0, 0.0), system, parameters.steps)
    noise = rng.multivariate_normal((0.0, 0.0), measurement, parameters.steps)
    x = parameters.prior_sigma_rad * rng.standard_normal(2)
    truth = np.empty((parameters.steps, 2))
    for step, each in enumerate(system_noise):
        moved = turn_together(
            x[0], x[1], parameters.coupling_rad, parameters.drift1_rad, parameters.drift2_rad
        )
        truth[step] = x = np.array(moved) + each
    elapsed_s = parameters.step_s * np.arange(parameters.steps + 1)
    time_ns = simulation_stamps_ns(elapsed_s)
    numbers = parameters.model_dump(exclude={"steps", "step_s", "prior_sigma_rad"})
    stated = state_metadata(HEADINGS) | {name: repr(value) for name, value in numbers.items()}
    return Recording(
        [
            prior_stream(
                "/prior", time_ns[0], HEADINGS, np.zeros(2), parameters.prior_sigma_rad**2 * np.eye(2)
            ),
            truth_stream("/truth", time_ns[1:], HEADINGS, wrap_angle(truth)),
            make_stream(
                "/headings",
                schemas.VECTOR_MEASUREMENT,
                time_ns[1:],
                metadata=stated,
                value=(truth + noise) % (2.0 * np.pi),
            ),
        ]
    )


TORUS_HEADINGS = Simulator(
    "two coupled headings; correlated noisy measurements of both",
    HeadingsParameters,
    simulate,
)
