"""Model of one vehicle with its own fixes, as in the paper's reference with known association.

Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, section 4.1. Each vehicle has its own estimate.

The modes for an interacting multiple model of a vehicle that turns and stops are not in the paper. The
vehicle drives as in the paper, manoeuvres with larger accelerations, or stands still; between driving
and standing, it brakes or starts, which is a manoeuvre.
"""

from typing import Any

from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.families.vehicles.models import noise_moments, turn
from fuselog.recorders.log import schemas
from fuselog.recorders.models.planar import Components
from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.inference.model.model import Model, Motion, Sensor, Switching
from fuselog.replay.inference.model.parameters import ModelParameters


class VehicleParameters(ModelParameters):
    """Motion of the vehicle, and rates of transitions between its modes.

    Attributes:
        turn_rate_radps: constant turn rate of the vehicle.
        acceleration_sigma_mps2: standard deviation of the acceleration during a time step, per axis.
        manoeuvring_sigma_mps2: standard deviation of the acceleration during a time step of a manoeuvre,
            per axis.
        standing_sigma_mps: standard deviation of the velocity of a standing vehicle, per axis.
        manoeuvres_per_s: rate of transitions from driving to a manoeuvre.
        settles_per_s: rate of transitions from a manoeuvre to driving.
        stops_per_s: rate of transitions from a manoeuvre to standing.
        starts_per_s: rate of transitions from standing to a manoeuvre.
    """

    turn_rate_radps: float | None = None
    acceleration_sigma_mps2: NonNegativeFloat | None = None
    sigma_fix_m: PositiveFloat | None = None
    manoeuvring_sigma_mps2: NonNegativeFloat = 3.0
    standing_sigma_mps: NonNegativeFloat = 0.05
    manoeuvres_per_s: NonNegativeFloat = 0.1
    settles_per_s: NonNegativeFloat = 0.2
    stops_per_s: NonNegativeFloat = 0.1
    starts_per_s: NonNegativeFloat = 0.1


def move(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Predict the vehicle by a coordinated turn."""
    return turn(state, parameters.turn_rate_radps, duration_s)


def acceleration_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the lower triangle of the covariance that white acceleration adds to (x, vx, y, vy)."""
    place, mixed, velocity = noise_moments(parameters.acceleration_sigma_mps2, duration_s)
    return place, mixed, velocity, 0.0, 0.0, place, 0.0, 0.0, mixed, velocity


def manoeuvring_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the noise of `acceleration_noise` for the larger accelerations of a manoeuvre."""
    place, mixed, velocity = noise_moments(parameters.manoeuvring_sigma_mps2, duration_s)
    return place, mixed, velocity, 0.0, 0.0, place, 0.0, 0.0, mixed, velocity


def stand(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Return the state with the same position and zero velocity."""
    return state[0], 0.0 * state[1], state[2], 0.0 * state[3]


def standing_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances of the small motion of a standing vehicle."""
    velocity = parameters.standing_sigma_mps**2
    return velocity * duration_s**2, velocity, velocity * duration_s**2, velocity


def mode_rates(parameters: Any) -> Components:
    """Return the rates at which driving, manoeuvring and standing change to the other modes."""
    return (
        parameters.manoeuvres_per_s,
        0.0,
        parameters.settles_per_s,
        parameters.stops_per_s,
        0.0,
        parameters.starts_per_s,
    )


def position(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the position of the vehicle."""
    return state[0], state[2]


def fix_noise(parameters: Any) -> Components:
    """Return the variances of a fix whose message contains none."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2


DRIVE = Motion(move, acceleration_noise, linear=True)
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
    DRIVE,
    {
        "drive": DRIVE,
        "manoeuvre": Motion(move, manoeuvring_noise, linear=True),
        "stand": Motion(stand, standing_noise, linear=True),
    },
    Switching(mode_rates),
)
