"""One vehicle from its own fixes: the paper's reference, association known.

Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, section 4.1. Each vehicle is an estimate of its own.
"""

from typing import Any

from pydantic import NonNegativeFloat, PositiveFloat

from recorders.log import schemas
from recorders.models.planar import Components
from recorders.models.states import PLANE_MOTION
from recorders.models.vehicles import noise_moments, turn
from replay.engine.measurements import PLANE
from replay.inference.estimators import modelled
from replay.inference.model import Model, ModelParameters, Motion, Sensor


class VehicleParameters(ModelParameters):
    """How the vehicle is supposed to move; None takes what its prior's channel states.

    A fix without a covariance has `sigma_fix_m` in both directions; without that it is not used.
    """

    turn_rate_radps: float | None = None
    acceleration_sigma_mps2: NonNegativeFloat | None = None
    sigma_fix_m: PositiveFloat | None = None


def move(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """A coordinated turn."""
    return turn(state, parameters.turn_rate_radps, duration_s)


def acceleration_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """The lower triangle of the covariance that white acceleration adds to (x, vx, y, vy)."""
    place, mixed, velocity = noise_moments(parameters.acceleration_sigma_mps2, duration_s)
    return place, mixed, velocity, 0.0, 0.0, place, 0.0, 0.0, mixed, velocity


def position(state: Components, about: Any, parameters: Any) -> Components:
    """Where the vehicle is."""
    return state[0], state[2]


def fix_noise(parameters: Any) -> Components:
    """The variances of a fix that does not state them."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2


VEHICLE = Model(
    "vehicle in the plane from its own fixes",
    dict.fromkeys(PLANE_MOTION, "linear"),
    VehicleParameters,
    (
        Sensor(
            "fix",
            schemas.POSITION_FIX,
            PLANE,
            position,
            fix_noise,
            vector="position_m",
            covariance="covariance_m2",
            linear=True,
        ),
    ),
    Motion(move, acceleration_noise, linear=True),
)
VEHICLE_KALMAN = modelled(VEHICLE, "ekf")
