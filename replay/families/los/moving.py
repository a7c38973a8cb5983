"""Model of moving targets, with attitude biases and clock offsets of airborne sensors.

The geometry is that of Belfadel, Osborne and Bar-Shalom, JAIF 2014
(`fuselog.recorders.families.los.models`), but targets and sensors move, and the sensors are not
synchronised. A message states the pose of its sensor, with a stamp by the sensor's own clock. If this
clock is ahead by c and the stamp is t, the sensor sees the targets at the time t - c: (azimuth,
elevation) = angles of R(bias) R(pose)' (target(t - c) - sensor's position). Biases and clock offsets can
be estimated together with the state (see `fuselog.replay.inference.model.augmentation`); with
`estimate_drift`, they are random walks.
"""

from typing import Any

from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.families.los.models import (
    SENSORS,
    TARGETS,
    azimuth_elevation,
    bias_components,
    clock_component,
    moving_target_components,
    rotate,
)
from fuselog.recorders.log import schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.planar import Component, Components
from fuselog.replay.engine.streams.measurements import SPACE
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters


class MovingSightParameters(ModelParameters):
    """Noise of motion and lines of sight, and errors of attitudes and clocks.

    Attributes:
        acceleration_density: noise of a target's acceleration, in m/s^2/sqrt(Hz).
        sigma_azimuth_rad: standard deviation of an azimuth.
        sigma_elevation_rad: standard deviation of an elevation.
        sensor_1_yaw_bias_rad, sensor_2_yaw_bias_rad, sensor_3_yaw_bias_rad: yaw bias of each sensor.
        sensor_1_pitch_bias_rad, sensor_2_pitch_bias_rad, sensor_3_pitch_bias_rad: pitch bias of each
            sensor.
        sensor_1_roll_bias_rad, sensor_2_roll_bias_rad, sensor_3_roll_bias_rad: roll bias of each sensor.
        sensor_1_clock_s, sensor_2_clock_s, sensor_3_clock_s: time by which the clock of each sensor is
            ahead.
    """

    acceleration_density: NonNegativeFloat | None = None
    sigma_azimuth_rad: PositiveFloat | None = None
    sigma_elevation_rad: PositiveFloat | None = None
    sensor_1_yaw_bias_rad: float = 0.0
    sensor_1_pitch_bias_rad: float = 0.0
    sensor_1_roll_bias_rad: float = 0.0
    sensor_1_clock_s: float = 0.0
    sensor_2_yaw_bias_rad: float = 0.0
    sensor_2_pitch_bias_rad: float = 0.0
    sensor_2_roll_bias_rad: float = 0.0
    sensor_2_clock_s: float = 0.0
    sensor_3_yaw_bias_rad: float = 0.0
    sensor_3_pitch_bias_rad: float = 0.0
    sensor_3_roll_bias_rad: float = 0.0
    sensor_3_clock_s: float = 0.0


def moved_target(state: Components, first: int, duration_s: Component) -> Components:
    """Predict the position of a target; `first` is the index of its first component."""
    return (
        state[first] + duration_s * state[first + 3],
        state[first + 1] + duration_s * state[first + 4],
        state[first + 2] + duration_s * state[first + 5],
    )


def move(state: Components, control: Any, duration_s: Any, parameters: Any) -> Components:
    """Move both targets at constant velocity."""
    x1, y1, z1 = moved_target(state, 0, duration_s)
    x2, y2, z2 = moved_target(state, 6, duration_s)
    velocity1, velocity2 = (state[3], state[4], state[5]), (state[9], state[10], state[11])
    return (x1, y1, z1, *velocity1, x2, y2, z2, *velocity2)


def move_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Compute the variances that white accelerations add.

    Covariances between the components are left out. These correlations hardly matter, because the noise
    of positions is a few millimetres in a step of a fraction of a second, and the lower triangle for 23
    components takes minutes to compile.
    """
    place, _, speed = noise_moments(parameters.acceleration_density**2, duration_s)
    return (place, place, place, speed, speed, speed, place, place, place, speed, speed, speed)


def to_body(orientation: Components, x: Components) -> Components:
    """Rotate a vector into the frame of a body with this orientation (w, x, y, z)."""
    w, a, b, c = orientation
    return (
        (w * w + a * a - b * b - c * c) * x[0]
        + 2.0 * (a * b + w * c) * x[1]
        + 2.0 * (a * c - w * b) * x[2],
        2.0 * (a * b - w * c) * x[0]
        + (w * w - a * a + b * b - c * c) * x[1]
        + 2.0 * (b * c + w * a) * x[2],
        2.0 * (a * c + w * b) * x[0]
        + 2.0 * (b * c - w * a) * x[1]
        + (w * w - a * a - b * b + c * c) * x[2],
    )


def sight(state: Components, reference: Components, bias: Components, clock_s: Any) -> Components:
    """Compute azimuth and elevation of a target in rad; `reference` has its number, and a pose."""
    second = 1.0 * (reference[0] == 2.0)
    one, other = moved_target(state, 0, -clock_s), moved_target(state, 6, -clock_s)
    offset = (
        one[0] + second * (other[0] - one[0]) - reference[1],
        one[1] + second * (other[1] - one[1]) - reference[2],
        one[2] + second * (other[2] - one[2]) - reference[3],
    )
    pose = (reference[4], reference[5], reference[6], reference[7])
    return azimuth_elevation(rotate(bias, to_body(pose, offset)))


def sight_noise(parameters: Any) -> Components:
    """Return the variances of both angles."""
    return parameters.sigma_azimuth_rad**2, parameters.sigma_elevation_rad**2


def _sensor(number: int) -> Sensor:
    biases, clock = tuple(bias_components(number)), clock_component(number)

    def see(state: Components, reference: Components, parameters: Any) -> Components:
        bias = tuple(getattr(parameters, name) for name in biases)
        return sight(state, reference, bias, getattr(parameters, clock))

    return Sensor(
        f"sensor{number}/moving_line_of_sight",
        schemas.MOVING_LINE_OF_SIGHT,
        {"azimuth_rad": "angle", "elevation_rad": "angle"},
        see,
        sight_noise,
        fields={"target_id": 1, "position_m": 3, "quaternion": 4},
    )


def first_target(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the position of the first target."""
    return state[0], state[1], state[2]


_NUMBERS = range(1, SENSORS + 1)
_BIASES: dict[str, Kind] = {name: "angle" for number in _NUMBERS for name in bias_components(number)}
_CLOCKS: dict[str, Kind] = {clock_component(number): "linear" for number in _NUMBERS}
MOVING_SIGHTS = Model(
    "two moving targets from the lines of sight of up to three moving sensors",
    {name: "linear" for target in range(1, TARGETS + 1) for name in moving_target_components(target)},
    MovingSightParameters,
    (
        *(_sensor(number) for number in _NUMBERS),
        Sensor(
            "target1/fix",
            schemas.POSITION_FIX,
            SPACE,
            first_target,
            vector="position_m",
            covariance="covariance_m2",
            linear=True,
        ),
    ),
    Motion(move, move_noise, linear=True),
    augmentable=_BIASES | _CLOCKS,
)
