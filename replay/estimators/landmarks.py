"""Localization of robots in the plane from odometry and other sensors.

The other sensors measure mapped landmarks, positions, poses and headings; a gyro can replace the turn
rate of the wheels. The state is (x_m, y_m, heading_rad); the velocity of an odometry message applies
until the next message. Thrun, Burgard and Fox, Probabilistic Robotics, chapters 3 and 7.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.models.planar import Components, drive, range_bearing
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.channels import heading_variance
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.inference.model.model import FIX, POSITION, Control, Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start

POSE: Mapping[str, Kind] = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}
LANDMARKS = Map("/landmarks", schemas.LANDMARK, "landmark_id", "position_m", PLANE)


class DeadReckoningParameters(ModelParameters):
    """Errors of odometry; the log's channels give the values of parameters that are None.

    A noise density is the standard deviation of the readings times the square root of the step between
    them: 0.1 m/s at 20 Hz is 0.1 * 0.05**0.5 = 0.022 m/s/sqrt(Hz).

    Attributes:
        forward_noise_density: noise of the forward speed, in m/s/sqrt(Hz): its standard deviation times
            the square root of the step.
        turn_noise_density: noise of the turn rate, in rad/s/sqrt(Hz): its standard deviation times the
            square root of the step.
        forward_scale: scale factor of the forward speed: the true speed divided by the odometry's speed.
        turn_scale: scale factor of the turn rate: the true turn rate, without the bias, divided by the
            odometry's turn rate.
        turn_bias_radps: bias of the turn rate, which is added to the odometry's turn rate after scaling.
    """

    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    forward_scale: float = 1.0
    turn_scale: float = 1.0
    turn_bias_radps: float = 0.0


class LocalizationParameters(DeadReckoningParameters):
    """Noise and biases of the sensors.

    Attributes:
        sigma_heading_rad: standard deviation of a heading whose message states no variance.
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        bias_range_m: bias of ranges: measured minus true.
        bias_bearing_rad: bias of bearings: measured minus true.
        bias_heading_rad: bias of headings, measured minus true; for example, because a compass is
            mounted at an angle.
        fix_delay_s: delay of position fixes: time from the measurement to the stamp.
        lever_x_m, lever_y_m: position of the antenna on the robot: ahead of, and to the left of, the
            point about which the robot turns.
    """

    sigma_heading_rad: PositiveFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    bias_range_m: float = 0.0
    bias_bearing_rad: float = 0.0
    bias_heading_rad: float = 0.0
    fix_delay_s: float = 0.0
    lever_x_m: float = 0.0
    lever_y_m: float = 0.0
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


def move(pose: Components, velocity: Components, duration_s: Any, parameters: Any) -> Components:
    """Move the pose along an arc."""
    forward, turn = velocity
    true = (
        parameters.forward_scale * forward,
        parameters.turn_scale * turn + parameters.turn_bias_radps,
    )
    return drive(pose, true, duration_s)


def velocity_noise(duration_s: Any, parameters: Any) -> Components:
    """Return the variances of white noise averaged over a time T: density^2 / T."""
    return (
        parameters.forward_noise_density**2 / duration_s,
        parameters.turn_noise_density**2 / duration_s,
    )


def sight(pose: Components, place: Components) -> Components:
    """Return range and bearing of a position, or NaN if the pose is at this position."""
    distance, bearing = range_bearing(pose, place)
    # 0, or NaN if the distance is 0: numba has no np.where for numbers
    defined = np.minimum(np.inf * (distance > 0.0), 0.0)
    return distance + defined, bearing + defined


def range_and_bearing(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return range and bearing of a landmark, with the sensor's biases."""
    distance, bearing = sight(pose, landmark)
    return distance + parameters.bias_range_m, bearing + parameters.bias_bearing_rad


def range_alone(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return only the range of a landmark, with the sensor's bias."""
    return (range_and_bearing(pose, landmark, parameters)[0],)


def bearing_alone(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return only the bearing of a landmark, with the sensor's bias."""
    return (range_and_bearing(pose, landmark, parameters)[1],)


def sight_noise(parameters: Any) -> Components:
    """Return the variances of range and bearing."""
    return parameters.sigma_range_m**2, parameters.sigma_bearing_rad**2


def range_noise(parameters: Any) -> Components:
    """Return the variance of the range."""
    return (parameters.sigma_range_m**2,)


def bearing_noise(parameters: Any) -> Components:
    """Return the variance of the bearing."""
    return (parameters.sigma_bearing_rad**2,)


def antenna(pose: Components, reference: Any, parameters: Any) -> Components:
    """Return the position of the antenna."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    forward, left = parameters.lever_x_m, parameters.lever_y_m
    return pose[0] + cosine * forward - sine * left, pose[1] + sine * forward + cosine * left


def fix_noise(parameters: Any) -> Components:
    """Return the variances of a fix whose message states no covariance."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2


def pose_itself(pose: Components, reference: Any, parameters: Any) -> Components:
    """Return the components of the pose."""
    return pose[0], pose[1], pose[2]


def pose_noise(parameters: Any) -> Components:
    """Return the variances of a pose whose message states no covariance."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2, parameters.sigma_heading_rad**2


def heading_alone(pose: Components, reference: Any, parameters: Any) -> Components:
    """Return the heading, with the sensor's bias."""
    return (pose[2] + parameters.bias_heading_rad,)


def heading_noise(parameters: Any) -> Components:
    """Return the variance of a heading whose message states no variance."""
    return (parameters.sigma_heading_rad**2,)


def read_pose(stream: Stream) -> Floats:
    """Project poses in space to poses in the plane (n, 3)."""
    return np.column_stack([stream["position_m"][:, :2], heading(stream["quaternion"])])


def read_pose_covariance(stream: Stream) -> Floats:
    """Return the covariances (n, 3, 3) of x, y and the rotation about z, in the axes of the frame."""
    return stream["covariance"].reshape(-1, 6, 6)[:, PLANAR][:, :, PLANAR]


def read_heading(stream: Stream) -> Floats:
    """Return the headings (n, 1) of orientations."""
    return heading(stream["quaternion"])[:, None]


def read_heading_covariance(stream: Stream) -> Floats:
    """Return the variances (n, 1, 1) of headings, as stated by the channel."""
    return np.full((len(stream), 1, 1), heading_variance(stream.metadata))


def align(
    path: Floats, places: Floats, covariances: Floats, span_s: float, parameters: Any
) -> tuple[Floats, Floats] | None:
    """Find the pose at the last of several fixes by aligning the antenna's path with the fixes.

    The path is rotated and shifted by least squares. The covariance includes the error of the odometry,
    which is a random walk: the variance of the difference between the walk's mean over the span and its
    end is a third of the walk's variance at the end.

    Args:
        path: poses (k, 3) at the stamps of the fixes, from the odometry only, starting at zero.
        places, covariances: positions (k, 2) in m of the fixes, and covariances (k, 2, 2).
        span_s: time from the first to the last fix.
        parameters: parameters with the antenna's position and the odometry's noise densities.

    Returns:
        The pose (3,) and its covariance (3, 3), or None while the standard deviation of the heading
        exceeds `COURSE_SIGMA_RAD`. See `start.Start`.
    """
    weight = 2.0 / np.trace(covariances, axis1=1, axis2=2)
    seen = np.stack(antenna(path.T, None, parameters), axis=1)
    middle, centre = (np.average(each, axis=0, weights=weight) for each in (seen, places))
    a, b = seen - middle, places - centre
    across, along = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.sum(a * b, axis=1)
    turn = np.arctan2(weight @ across, weight @ along)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    turned = a @ rotation.T
    last = turned[-1] - rotation @ (seen[-1] - path[-1, :2])
    arms = turned - last
    rows = np.zeros((len(path), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, 0, 2], rows[:, 1, 2] = -arms[:, 1], arms[:, 0]
    information = np.einsum("kia,kij,kjb->ab", rows, np.linalg.inv(covariances), rows)
    if np.linalg.matrix_rank(information) < 3:
        return None
    covariance = np.linalg.inv(information)
    densities = parameters.forward_noise_density, parameters.turn_noise_density
    forward, turning = (density**2 * span_s / 3.0 for density in densities)
    covariance += np.diag([forward, forward, turning])
    if covariance[2, 2] > COURSE_SIGMA_RAD**2:
        return None
    return np.array([*(centre + last), path[-1, 2] + turn]), covariance


def read_turn_rate(stream: Stream) -> Floats:
    """Return turn rates (n, 1) about the vertical axis from a gyro that is mounted upright."""
    return stream["turn_rate_radps"][:, 2:]


COURSE_SIGMA_RAD = 0.1  # of a heading that is accurate enough for linearisation
PLANAR = [0, 1, 5]  # x, y and the rotation about z, among the six components of a pose
RANGE: Mapping[str, Kind] = {"range_m": "linear"}
BEARING: Mapping[str, Kind] = {"bearing_rad": "angle"}
DRIVE_ERRORS: Mapping[str, Kind] = {"forward_scale": "linear", "turn_bias_radps": "linear"}
SIGHT_ERRORS: Mapping[str, Kind] = {"bias_range_m": "linear", "bias_bearing_rad": "angle"}
COMPASS_ERRORS: Mapping[str, Kind] = {"bias_heading_rad": "angle"}
LEVER: Mapping[str, Kind] = {"lever_x_m": "linear", "lever_y_m": "linear"}
# Each parameter counts as determined up to this standard deviation: 1 %, 0.01 rad/s.
DRIVE_CALIBRATION: Mapping[str, float] = {
    "forward_scale": 0.01,
    "turn_scale": 0.01,
    "turn_bias_radps": 0.01,
}
MOTION = Motion(move, control_noise=velocity_noise)
TURN_RATE = Control(
    "turn_rate",
    schemas.INERTIAL_SAMPLE,
    ("turn_radps",),
    read_turn_rate,
    noise={"turn_noise_density": ("turn_noise_density", "gyro_noise_density")},
)
ODOMETRY = Control(
    "odometry",
    schemas.ODOMETRY,
    ("forward_mps", "turn_radps"),
    estimates=True,
    fallbacks=(TURN_RATE,),
)
# For logs that were not recorded for this model: slipping wheels of an indoor robot.
START = Start(
    {"x_m": 1000.0, "y_m": 1000.0, "heading_rad": np.pi / np.sqrt(3.0)},
    {"forward_noise_density": 0.05, "turn_noise_density": 0.05},
    align,
)
ROBOT = Model(
    "robot pose from odometry, mapped landmarks, fixes and poses",
    POSE,
    LocalizationParameters,
    (
        Sensor(
            "range_bearing",
            schemas.RANGE_BEARING,
            {**RANGE, **BEARING},
            range_and_bearing,
            sight_noise,
            reference=LANDMARKS,
        ),
        Sensor("range", schemas.RANGE, RANGE, range_alone, range_noise, reference=LANDMARKS),
        Sensor("bearing", schemas.BEARING, BEARING, bearing_alone, bearing_noise, reference=LANDMARKS),
        Sensor(
            "pose",
            schemas.POSE,
            POSE,
            pose_itself,
            pose_noise,
            read=read_pose,
            covariance=read_pose_covariance,
            linear=True,
        ),
        Sensor(
            "heading",
            schemas.ORIENTATION,
            {"heading_rad": "angle"},
            heading_alone,
            heading_noise,
            read=read_heading,
            covariance=read_heading_covariance,
            linear=True,
        ),
        Sensor(
            FIX,
            schemas.POSITION_FIX,
            {name: POSE[name] for name in POSITION[:2]},
            antenna,
            fix_noise,
            vector="position_m",
            covariance="covariance_m2",
            delay="fix_delay_s",
        ),
    ),
    MOTION,
    control=ODOMETRY,
    output="pose",
    augmentable={**SIGHT_ERRORS, **COMPASS_ERRORS, **DRIVE_ERRORS, **LEVER},
    calibration={
        **DRIVE_CALIBRATION,
        **dict.fromkeys(LEVER, 0.2),
        "fix_delay_s": 0.05,
        "bias_heading_rad": 0.02,
        "bias_range_m": 0.2,
        "bias_bearing_rad": 0.02,
    },
    start=START,
)
