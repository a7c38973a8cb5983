"""A static rectangle; a sensor sees one noisy point of its surface per time step.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.B: points are uniform over the surface with Gaussian noise.
"""

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import prior_stream, stated_numbers, truth_stream
from fuselog.recorders.families.sampling.extended_target import surface_point
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

COMPONENTS = ("half_x_m", "half_y_m", "x_m", "y_m")
Target = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]


class ExtendedTargetParameters(Parameters):
    """A rectangle, its measured points, and the assumptions of a filter.

    Attributes:
        points: number of points, one per time step.
        step_s: length of a time step.
        target: the true rectangle (half_x_m, half_y_m, x_m, y_m).
        point_variance_m2: variance of a measured point, per axis.
        size_drift_m2: variance that a filter adds to the half sides per step; the true half sides are
            constant.
        position_drift_m2: variance that a filter adds to the position per step; the true position is
            constant.
        prior_mean: mean of the prior (half_x_m, half_y_m, x_m, y_m).
        prior_variance_m2: variance of each component in the prior.
    """

    points: PositiveInt = 150
    step_s: PositiveFloat = 1.0
    target: Target = (4.0, 2.0, 3.0, 5.0)
    point_variance_m2: PositiveFloat = 1.0
    size_drift_m2: NonNegativeFloat = 1e-4
    position_drift_m2: NonNegativeFloat = 1e-3
    prior_mean: Target = (1.0, 1.0, 0.0, 0.0)
    prior_variance_m2: PositiveFloat = 1.0


def simulate(parameters: ExtendedTargetParameters, rng: np.random.Generator) -> Recording:
    """Record one run."""
    target = np.array(parameters.target)
    scale = rng.uniform(-1, 1, (2, parameters.points))
    seen = np.stack(surface_point(target, scale), axis=1)
    seen += rng.normal(size=seen.shape) * np.sqrt(parameters.point_variance_m2)
    stamps_ns = simulation_stamps_ns(parameters.step_s * np.arange(parameters.points + 1))
    return Recording(
        [
            prior_stream(
                "/prior",
                stamps_ns[0],
                COMPONENTS,
                parameters.prior_mean,
                parameters.prior_variance_m2 * np.eye(4),
            ),
            truth_stream("/truth", stamps_ns, COMPONENTS, np.tile(target, (len(stamps_ns), 1))),
            make_stream(
                "/surface_point",
                schemas.POSITION_FIX,
                stamps_ns[1:],
                metadata={"system": "extended-target"}
                | stated_numbers(parameters, "size_drift_m2", "position_drift_m2", "point_variance_m2"),
                position_m=seen,
                covariance_m2=np.tile(parameters.point_variance_m2 * np.eye(2).ravel(), (len(seen), 1)),
            ),
        ]
    )


EXTENDED_TARGET = Simulator(
    "a static rectangle; noisy points of its surface are measured one at a time",
    ExtendedTargetParameters,
    simulate,
)
