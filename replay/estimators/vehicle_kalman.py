"""One vehicle from its own fixes: the paper's reference, association known.

Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the symmetric
measurement equation filter", 2016, section 4.1. Each vehicle is an estimate of its own.
"""

from typing import Any

from pydantic import NonNegativeFloat

from recorders.log import schemas
from recorders.models.planar import Components
from recorders.models.states import PLANE_MOTION
from recorders.models.vehicles import noise_moments, turn
from replay.inference.estimators import modelled
from replay.inference.model import Model, ModelParameters, Motion, Sensor


class VehicleParameters(ModelParameters):
    """How the vehicle is supposed to move; None takes what its prior's channel states."""

    turn_rate_radps: float | None = None
    acceleration_sigma_mps2: NonNegativeFloat | None = None


def move(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:  # noqa: ARG001
    """A coordinated turn."""
    return turn(state, parameters.turn_rate_radps, duration_s)


def acceleration_noise(state: Components, duration_s: Any, parameters: Any) -> Components:  # noqa: ARG001
    """The lower triangle of the covariance that white acceleration adds to (x, vx, y, vy)."""
    place, mixed, velocity = noise_moments(parameters.acceleration_sigma_mps2, duration_s)
    return place, mixed, velocity, 0.0, 0.0, place, 0.0, 0.0, mixed, velocity


def position(state: Components, about: Any, parameters: Any) -> Components:  # noqa: ARG001
    """Where the vehicle is."""
    return state[0], state[2]


VEHICLE = Model(
    "vehicle in the plane from its own fixes",
    dict.fromkeys(PLANE_MOTION, "linear"),
    VehicleParameters,
    (
        Sensor(
            "fix",
            schemas.POSITION_FIX,
            {"x_m": "linear", "y_m": "linear"},
            position,
            covariance="covariance_m2",
            read=lambda stream: stream["position_m"],
            linear=True,
        ),
    ),
    Motion(move, acceleration_noise, linear=True),
)
VEHICLE_KALMAN = modelled(VEHICLE, "ekf")
