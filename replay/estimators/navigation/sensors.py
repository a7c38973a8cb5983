"""Models of additional sensors of a body with an inertial unit, such as a compass or wheels.

The sensors measure the state of `navigation`; each has its own topic, which a log may lack. Groves,
Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2013, chapters
6 and 15.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.inertial import cross, distance, into_body, into_plane
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.models.planar import Components
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.channels import heading_variance
from fuselog.replay.engine.streams.measurements import SPACE
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.estimators.navigation.alignment import turn_rate
from fuselog.replay.inference.model.model import Control, Map, Sensor

ANCHORS = Map("/anchors", schemas.LANDMARK, "landmark_id", "position_m", SPACE, "anchor_id")
TAGS = Map("/tags", schemas.BODY_POINT, "point_id", "position_m", SPACE, "tag_id")
RANGE: Mapping[str, Kind] = {"range_m": "linear"}


def be_headed(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the direction of the body's forward axis in the plane, in rad from east towards north."""
    _, _, _, _, _, _, qw, qx, qy, qz, _, _, _, _, _, _ = state
    east, north, _ = into_plane((qw, qx, qy, qz), (1.0, 0.0, 0.0))
    return (np.arctan2(north, east),)


def be_high(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the height above the plane's origin."""
    _, _, pz, _, _, _, _, _, _, _, _, _, _, _, _, _ = state
    return (pz,)


def roll_along(state: Components, samples: Components, parameters: Any) -> Components:
    """Return the velocity (forward, left, up) of wheels that neither slip sideways nor lift off."""
    _, _, _, vx, vy, vz, qw, qx, qy, qz, gx, gy, gz, _, _, _ = state
    wx, wy, wz = turn_rate(samples, (gx, gy, gz), parameters)
    axle = parameters.axle_x_m, parameters.axle_y_m, parameters.axle_z_m
    x, y, z = into_body((qw, qx, qy, qz), (vx, vy, vz))
    a, b, c = cross((wx, wy, wz), axle)
    return (1.0 + parameters.wheel_scale) * (x + a), y + b, z + c


def stand(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the velocity, which is zero if the body stands still."""
    _, _, _, vx, vy, vz, _, _, _, _, _, _, _, _, _, _ = state
    return vx, vy, vz


def stay_on_wheels(state: Components, samples: Components, parameters: Any) -> Components:
    """Return the velocity of the axle to the left and up; see `roll_along`."""
    _, left, up = roll_along(state, samples, parameters)
    return left, up


def feel_north(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the magnetic field in the body's axes."""
    _, _, _, _, _, _, qw, qx, qy, qz, _, _, _, _, _, _ = state
    field = parameters.field_east_ut, parameters.field_north_ut, parameters.field_up_ut
    return into_body((qw, qx, qy, qz), field)


def see_anchor(state: Components, reference: Components, parameters: Any) -> Components:
    """Return the range from a tag on the body to an anchor; `reference` has the anchor, then the tag."""
    px, py, pz, _, _, _, qw, qx, qy, qz, _, _, _, _, _, _ = state
    ax, ay, az, tx, ty, tz = reference
    x, y, z = into_plane((qw, qx, qy, qz), (tx, ty, tz))
    return (distance((px + x, py + y, pz + z), (ax, ay, az)),)


def heading_noise(parameters: Any) -> Components:
    """Return the variance of a heading."""
    return (parameters.sigma_heading_rad**2,)


def height_noise(parameters: Any) -> Components:
    """Return the variance of a height."""
    return (parameters.sigma_height_m**2,)


def wheel_noise(parameters: Any) -> Components:
    """Return the variances of the wheels' forward speed and of their sideways and upward slip."""
    slip = parameters.sigma_slip_mps**2
    return parameters.sigma_wheel_mps**2, slip, slip


def standing_noise(parameters: Any) -> Components:
    """Return the variances of a zero-velocity measurement."""
    variance = parameters.sigma_standing_mps**2
    return variance, variance, variance


def slip_noise(parameters: Any) -> Components:
    """Return the variances of the wheels' sideways and upward slip."""
    variance = parameters.sigma_slip_mps**2
    return variance, variance


def field_noise(parameters: Any) -> Components:
    """Return the variances of a field whose message states no covariance."""
    variance = parameters.sigma_field_ut**2
    return variance, variance, variance


def range_noise(parameters: Any) -> Components:
    """Return the variance of a range."""
    return (parameters.sigma_range_m**2,)


def read_heading(stream: Stream) -> Floats:
    """Return the headings (n, 1) of orientations."""
    return heading(stream["quaternion"])[:, None]


def heading_sigma(metadata: Mapping[str, str]) -> float:
    """Return the standard deviation of headings, from the variance that their channel states."""
    return float(np.sqrt(heading_variance(metadata)))


def read_height(stream: Stream) -> Floats:
    """Return heights (n, 1)."""
    return stream["value"][:, :1]


def read_wheels(stream: Stream) -> Floats:
    """Return the velocities of the wheels (n, 3): forward as measured, zero to the left and up."""
    forward = stream["forward_mps"]
    return np.stack([forward, np.zeros(len(forward)), np.zeros(len(forward))], axis=1)


def read_standing(stream: Stream) -> Floats:
    """Return zero velocities (n, 3) for nonzero values, and NaN for zeros, when the body may move."""
    stands = stream["value"][:, :1] != 0.0
    return np.where(stands, 0.0, np.full((len(stands), 3), np.nan))


def read_rolling(stream: Stream) -> Floats:
    """Return zero velocities (n, 2) to the left and up for nonzero values, and NaN for zeros."""
    return read_standing(stream)[:, :2]


def carried_sensors(unit: Control) -> tuple[Sensor, ...]:
    """Return the additional sensors of a body with this inertial unit."""
    return (
        Sensor(
            "heading",
            schemas.ORIENTATION,
            {"heading_rad": "angle"},
            be_headed,
            heading_noise,
            read=read_heading,
            stated={"sigma_heading_rad": heading_sigma},
        ),
        Sensor(
            "height",
            schemas.VECTOR_MEASUREMENT,
            {"z_m": "linear"},
            be_high,
            height_noise,
            read=read_height,
            linear=True,
        ),
        Sensor(
            "wheel",
            schemas.ODOMETRY,
            {f"{axis}_mps": "linear" for axis in ("forward", "left", "up")},
            roll_along,
            wheel_noise,
            read=read_wheels,
            control=unit,
        ),
        Sensor(
            "standing",
            schemas.VECTOR_MEASUREMENT,
            {f"v{axis}_mps": "linear" for axis in "xyz"},
            stand,
            standing_noise,
            read=read_standing,
            linear=True,
            delay="standing_delay_s",
        ),
        Sensor(
            "rolling",
            schemas.VECTOR_MEASUREMENT,
            {"left_mps": "linear", "up_mps": "linear"},
            stay_on_wheels,
            slip_noise,
            read=read_rolling,
            control=unit,
        ),
        Sensor(
            "magnetic_field",
            schemas.MAGNETIC_FIELD,
            {f"field_{axis}_ut": "linear" for axis in "xyz"},
            feel_north,
            field_noise,
            vector="magnetic_field_ut",
            covariance="covariance_ut2",
        ),
        Sensor(
            "ranges",
            schemas.ANCHOR_RANGE,
            RANGE,
            see_anchor,
            range_noise,
            reference=(ANCHORS, TAGS),
            delay="range_delay_s",
        ),
    )
