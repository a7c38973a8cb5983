"""Navigation by an inertial unit, corrected by the position and velocity measurements of a log.

The control is an inertial unit. The state has 15 components: position and velocity in a local tangent
plane (east, north, up), the orientation of the body (forward, left, up) in this plane, and the biases of
gyro and accelerometer. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
Systems, 2nd edition, 2013, chapter 14; the error of the orientation is in the body's axes.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.inertial import cross, into_plane, strapdown
from fuselog.recorders.models.planar import Components
from fuselog.recorders.models.states import NAVIGATION
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.components import components_of
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.estimators.navigation.alignment import (
    AlignmentParameters,
    align,
    check_prior,
    specific_force,
    turn_rate,
)
from fuselog.replay.estimators.navigation.sensors import carried_sensors
from fuselog.replay.estimators.navigation.turning import WITH_HEADING
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.start import Start

LEVER: Mapping[str, Kind] = {f"lever_{axis}_m": "linear" for axis in "xyz"}
MOUNTING: Mapping[str, Kind] = {f"mounting_{turn}_rad": "angle" for turn in ("roll", "pitch", "yaw")}
SCALES: Mapping[str, Kind] = {
    f"{of}_scale_{axis}": "linear" for of in ("force", "gyro") for axis in "xyz"
}
WHEEL: Mapping[str, Kind] = {"wheel_scale": "linear", **{f"axle_{axis}_m": "linear" for axis in "xyz"}}
STATE = components_of(NAVIGATION)
POSITION, VELOCITY = components_of(NAVIGATION[:3]), components_of(NAVIGATION[3:6])


class NavigationParameters(AlignmentParameters):
    """Noise of the inertial unit and other sensors, their mounting, and gaps.

    The biases are in the body's axes. Gravity and the earth's rotation have their values at the origin
    of the plane. After more than `inertial_gap_s` without samples, everything except the biases becomes
    uncertain: the body may have accelerated, turned and tilted, with the standard deviations given for a
    gap.

    Attributes:
        force_noise_density: white noise of the specific force, in m/s^2/sqrt(Hz).
        gyro_noise_density: white noise of the turn rate, in rad/s/sqrt(Hz).
        force_bias_density: random walk of the accelerometer's bias, in m/s^2/sqrt(s).
        gyro_bias_density: random walk of the gyro's bias, in rad/s/sqrt(s).
        origin_latitude_deg: latitude of the plane's origin.
        origin_altitude_m: height of the plane's origin above the WGS 84 ellipsoid.
        inertial_gap_s: time without samples above which a gap is assumed.
        gap_acceleration_mps2: standard deviation of the acceleration in a gap.
        gap_turn_radps: standard deviation of the turn rate in a gap.
        gap_tilt_rad: standard deviation of the tilt after a gap.
        lever_x_m, lever_y_m, lever_z_m: position of the antenna relative to the unit in body axes
            (forward, left, up).
        axle_x_m, axle_y_m, axle_z_m: position of the wheels' axle relative to the unit in body axes
            (forward, left, up).
        wheel_scale: how much the speed that the wheels measure exceeds the true speed, as a fraction of
            the true speed.
        field_east_ut, field_north_ut, field_up_ut: local magnetic field by direction.
        range_delay_s: delay of ranges: time from the measurement to the stamp.
        standing_delay_s: delay of the messages that state whether the body stands still: time from the
            measurement to the stamp.
        sigma_velocity_mps: standard deviation of each component of a velocity whose message states no
            covariance.
        sigma_heading_rad: standard deviation of a heading.
        sigma_height_m: standard deviation of a height.
        sigma_wheel_mps: standard deviation of the wheels' forward speed.
        sigma_slip_mps: standard deviation of the wheels' sideways and upward velocity, whose mean is
            zero.
        sigma_standing_mps: standard deviation of the velocity of a body that stands still, per axis.
        sigma_field_ut: standard deviation of the magnetic field, per axis.
        sigma_range_m: standard deviation of a range.
    """

    force_noise_density: NonNegativeFloat | None = None
    gyro_noise_density: NonNegativeFloat | None = None
    force_bias_density: NonNegativeFloat | None = None
    gyro_bias_density: NonNegativeFloat | None = None
    origin_latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    origin_altitude_m: float | None = None
    inertial_gap_s: PositiveFloat = 1.0
    gap_acceleration_mps2: PositiveFloat = 2.0
    gap_turn_radps: PositiveFloat = 0.2
    gap_tilt_rad: PositiveFloat = 0.1
    lever_x_m: float = 0.0
    lever_y_m: float = 0.0
    lever_z_m: float = 0.0
    axle_x_m: float | None = None
    axle_y_m: float | None = None
    axle_z_m: float | None = None
    wheel_scale: float = 0.0
    field_east_ut: float | None = None
    field_north_ut: float | None = None
    field_up_ut: float | None = None
    range_delay_s: float = 0.0
    standing_delay_s: float = 0.0
    sigma_velocity_mps: PositiveFloat | None = None
    sigma_heading_rad: PositiveFloat | None = None
    sigma_height_m: PositiveFloat | None = None
    sigma_wheel_mps: PositiveFloat | None = None
    sigma_slip_mps: PositiveFloat = 0.1
    sigma_standing_mps: PositiveFloat = 0.01
    sigma_field_ut: PositiveFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.9999986
    gate_reopens_s: PositiveFloat | None = 1.0


def read_inertial(stream: Stream) -> Floats:
    """Return the specific force and turn rate (n, 6) of inertial samples."""
    return np.hstack([stream["specific_force_mps2"], stream["turn_rate_radps"]])


def move(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the state after a step, given the mean of the samples at the step's two ends."""
    px, py, pz, vx, vy, vz, qw, qx, qy, qz, gx, gy, gz, bx, by, bz = state
    moved = strapdown(
        (px, py, pz, vx, vy, vz, qw, qx, qy, qz),
        specific_force(control, (bx, by, bz), parameters),
        turn_rate(control, (gx, gy, gz), parameters),
        duration_s,
        (parameters.origin_latitude_deg, parameters.origin_altitude_m),
    )
    px, py, pz, vx, vy, vz, qw, qx, qy, qz = moved
    return px, py, pz, vx, vy, vz, qw, qx, qy, qz, gx, gy, gz, bx, by, bz


def move_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances added by white noise of the samples and random walks of their biases."""
    force = parameters.force_noise_density**2 * duration_s
    rate = parameters.gyro_noise_density**2 * duration_s
    gyro_bias = parameters.gyro_bias_density**2 * duration_s
    force_bias = parameters.force_bias_density**2 * duration_s
    placed, moved, turned = (0.0, 0.0, 0.0), (force, force, force), (rate, rate, rate)
    gyro, accelerometer = (gyro_bias, gyro_bias, gyro_bias), (force_bias, force_bias, force_bias)
    return placed + moved + turned + gyro + accelerometer


def gap_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances added by a gap of the unit, in which the body may have moved and turned."""
    speed_squared = state[3] ** 2 + state[4] ** 2 + state[5] ** 2
    gained = (parameters.gap_acceleration_mps2 * duration_s) ** 2
    moved = (speed_squared + 0.25 * gained) * duration_s**2
    tilted = parameters.gap_tilt_rad**2
    turned = (parameters.gap_turn_radps * duration_s) ** 2
    return moved, moved, moved, gained, gained, gained, tilted, tilted, turned, *(0.0,) * 6


def position(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the position of the end of the lever arm."""
    lever = parameters.lever_x_m, parameters.lever_y_m, parameters.lever_z_m
    px, py, pz, _, _, _, qw, qx, qy, qz, _, _, _, _, _, _ = state
    x, y, z = into_plane((qw, qx, qy, qz), lever)
    return px + x, py + y, pz + z


def velocity(state: Components, samples: Components, parameters: Any) -> Components:
    """Return the velocity of the end of the lever arm, which turns with the body."""
    _, _, _, vx, vy, vz, qw, qx, qy, qz, gx, gy, gz, _, _, _ = state
    rate = turn_rate(samples, (gx, gy, gz), parameters)
    lever = parameters.lever_x_m, parameters.lever_y_m, parameters.lever_z_m
    x, y, z = into_plane((qw, qx, qy, qz), cross(rate, lever))
    return vx + x, vy + y, vz + z


def fix_noise(parameters: Any) -> Components:
    """Return the variances of a fix whose message states no covariance."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2, parameters.sigma_fix_m**2


def velocity_noise(parameters: Any) -> Components:
    """Return the variances of a velocity whose message states no covariance."""
    variance = parameters.sigma_velocity_mps**2
    return variance, variance, variance


# For a log that was not recorded for this model: a small unit that is carried around, anywhere on earth.
HANDHELD = {
    "force_noise_density": 0.05,
    "gyro_noise_density": 0.001,
    "force_bias_density": 3e-4,
    "gyro_bias_density": 2e-6,
    "origin_latitude_deg": 45.0,
    "origin_altitude_m": 0.0,
    "axle_x_m": 0.0,
    "axle_y_m": 0.0,
    "axle_z_m": 0.0,
}
UNIT = Control(
    "inertial",
    schemas.INERTIAL_SAMPLE,
    tuple(f"force_{axis}_mps2" for axis in "xyz") + tuple(f"rate_{axis}_radps" for axis in "xyz"),
    read_inertial,
    interpolated=True,
    gap="inertial_gap_s",
    delay="inertial_delay_s",
)
INERTIAL = Model(
    "position, velocity and orientation from an inertial unit, and its biases",
    STATE,
    NavigationParameters,
    (
        Sensor(
            "fix",
            schemas.POSITION_FIX,
            POSITION,
            position,
            fix_noise,
            vector="position_m",
            covariance="covariance_m2",
            delay="fix_delay_s",
        ),
        Sensor(
            "velocity",
            schemas.VELOCITY_FIX,
            VELOCITY,
            velocity,
            velocity_noise,
            vector="velocity_mps",
            covariance="covariance_m2ps2",
            delay="velocity_delay_s",
            control=UNIT,
        ),
        *carried_sensors(UNIT),
    ),
    Motion(move, move_noise, gap_noise=gap_noise),
    control=UNIT,
    start=Start({}, HANDHELD, find=align, check_prior=check_prior),
    correct=WITH_HEADING,
    augmentable={**LEVER, **MOUNTING, **SCALES, **WHEEL},
    calibration={
        **dict.fromkeys(LEVER, 0.2),
        **dict.fromkeys(MOUNTING, 0.02),
        **dict.fromkeys((*SCALES, "wheel_scale"), 0.01),
        **dict.fromkeys(("fix_delay_s", "velocity_delay_s"), 0.05),
    },
)
