"""Localization of robots in the plane from odometry and sightings of mapped landmarks.

The state is (x_m, y_m, heading_rad); the odometry's velocity holds until the next one. Thrun, Burgard
and Fox, Probabilistic Robotics, chapters 3 and 7.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from recorders.log import schemas
from recorders.models.planar import Components, drive, range_bearing
from replay.engine.measurements import PLANE
from replay.engine.tangent import Kind
from replay.inference.all_methods import modelled
from replay.inference.model import Control, Map, Model, ModelParameters, Motion, Sensor

POSE: Mapping[str, Kind] = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}
LANDMARKS = Map("/landmarks", schemas.LANDMARK, "landmark_id", "position_m", PLANE)


class DeadReckoningParameters(ModelParameters):
    """Noise densities are per square root of a second; None takes what the log's channels state.

    The robot drives `forward_scale` times what the odometry says, and turns faster by `turn_bias_radps`.
    """

    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    forward_scale: float = 1.0
    turn_bias_radps: float = 0.0


class LocalizationParameters(DeadReckoningParameters):
    """Sensor noise and bias, and how improbable a measurement must be to be kept out."""

    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    bias_range_m: float = 0.0
    bias_bearing_rad: float = 0.0
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


def move(pose: Components, velocity: Components, duration_s: Any, parameters: Any) -> Components:
    """The pose at the end of an arc."""
    forward, turn = velocity
    true = parameters.forward_scale * forward, turn + parameters.turn_bias_radps
    return drive(pose, true, duration_s)


def velocity_noise(duration_s: Any, parameters: Any) -> Components:
    """The mean of white noise over a time T has the variance density^2 / T."""
    return (
        parameters.forward_noise_density**2 / duration_s,
        parameters.turn_noise_density**2 / duration_s,
    )


def sight(pose: Components, place: Components) -> Components:
    """Range and bearing of a place; NaN on the very spot, where neither has a derivative."""
    distance, bearing = range_bearing(pose, place)
    # 0, or NaN where the distance is 0: numba has no np.where for numbers
    defined = np.minimum(np.inf * (distance > 0.0), 0.0)
    return distance + defined, bearing + defined


def see(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Range and bearing of a landmark, with the sensor's bias."""
    distance, bearing = sight(pose, landmark)
    return distance + parameters.bias_range_m, bearing + parameters.bias_bearing_rad


def see_range(pose: Components, landmark: Components, parameters: Any) -> Components:
    """The range alone."""
    return (see(pose, landmark, parameters)[0],)


def see_bearing(pose: Components, landmark: Components, parameters: Any) -> Components:
    """The bearing alone."""
    return (see(pose, landmark, parameters)[1],)


def sight_noise(parameters: Any) -> Components:
    """Variances of range and bearing."""
    return parameters.sigma_range_m**2, parameters.sigma_bearing_rad**2


def range_noise(parameters: Any) -> Components:
    """Variance of the range."""
    return (parameters.sigma_range_m**2,)


def bearing_noise(parameters: Any) -> Components:
    """Variance of the bearing."""
    return (parameters.sigma_bearing_rad**2,)


RANGE: Mapping[str, Kind] = {"range_m": "linear"}
BEARING: Mapping[str, Kind] = {"bearing_rad": "angle"}
DRIVE_ERRORS: Mapping[str, Kind] = {"forward_scale": "linear", "turn_bias_radps": "linear"}
SIGHT_ERRORS: Mapping[str, Kind] = {"bias_range_m": "linear", "bias_bearing_rad": "angle"}
MOTION = Motion(move, control_noise=velocity_noise)
ODOMETRY = Control("odometry", schemas.ODOMETRY, ("forward_mps", "turn_radps"), estimates=True)
ROBOT = Model(
    "robot pose from odometry and mapped landmarks",
    POSE,
    LocalizationParameters,
    (
        Sensor(
            "range_bearing",
            schemas.RANGE_BEARING,
            {**RANGE, **BEARING},
            see,
            sight_noise,
            about=LANDMARKS,
        ),
        Sensor("range", schemas.RANGE, RANGE, see_range, range_noise, about=LANDMARKS),
        Sensor("bearing", schemas.BEARING, BEARING, see_bearing, bearing_noise, about=LANDMARKS),
    ),
    MOTION,
    control=ODOMETRY,
    output="pose",
    estimable={**SIGHT_ERRORS, **DRIVE_ERRORS},
)
RECKONING = Model(
    "robot pose from odometry alone",
    POSE,
    DeadReckoningParameters,
    (),
    MOTION,
    control=ODOMETRY,
    output="pose",
    needs_sensor=False,
    estimable=DRIVE_ERRORS,
)
DEAD_RECKONING = modelled(RECKONING, "ekf")
