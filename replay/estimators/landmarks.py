"""Localizes robots in the plane from odometry and whatever else there is.

Sightings of mapped landmarks, position fixes, poses, headings; a gyro may say how fast the robot turns
in place of its wheels. The state is (x_m, y_m, heading_rad); the odometry's velocity holds until the
next one. Thrun, Burgard and Fox, Probabilistic Robotics, chapters 3 and 7.
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
from fuselog.replay.inference.all_methods import modelled
from fuselog.replay.inference.model.model import FIX, POSITION, Control, Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start

POSE: Mapping[str, Kind] = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}
LANDMARKS = Map("/landmarks", schemas.LANDMARK, "landmark_id", "position_m", PLANE)


class DeadReckoningParameters(ModelParameters):
    """States what odometry errs by; None takes what the log's channels state.

    A noise density is the standard deviation of the readings times the root of the step between them:
    0.1 m/s at 20 Hz is 0.1 * 0.05**0.5 = 0.022 m/s/sqrt(Hz).

    Attributes:
        forward_noise_density: noise of the forward speed, in m/s/sqrt(Hz): its standard deviation times
            the root of the step.
        turn_noise_density: noise of the turn rate, in rad/s/sqrt(Hz): its standard deviation times the
            root of the step.
        forward_scale: the robot drives so many times what the odometry says.
        turn_scale: the robot turns so many times what the odometry says, before the bias is added.
        turn_bias_radps: the robot turns faster by so much than the odometry says.
    """

    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    forward_scale: float = 1.0
    turn_scale: float = 1.0
    turn_bias_radps: float = 0.0


class LocalizationParameters(DeadReckoningParameters):
    """States noise and bias of the sensors.

    Attributes:
        sigma_heading_rad: standard deviation of a heading, or of a pose's angle, that does not state it.
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        bias_range_m: ranges are too long by so much.
        bias_bearing_rad: bearings are too large by so much.
        bias_heading_rad: headings are too large by so much, as of a compass that is mounted turned.
        fix_delay_s: a position was measured so long before its stamp.
        lever_x_m, lever_y_m: where the antenna whose position fixes say is on the robot, ahead of and to
            the left of the point that it turns about.
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
    """Return the pose at the end of an arc."""
    forward, turn = velocity
    true = (
        parameters.forward_scale * forward,
        parameters.turn_scale * turn + parameters.turn_bias_radps,
    )
    return drive(pose, true, duration_s)


def velocity_noise(duration_s: Any, parameters: Any) -> Components:
    """Return the variances of means of white noise over a time T: density^2 / T."""
    return (
        parameters.forward_noise_density**2 / duration_s,
        parameters.turn_noise_density**2 / duration_s,
    )


def sight(pose: Components, place: Components) -> Components:
    """Return range and bearing of a place; NaN on the very spot, where neither has a derivative."""
    distance, bearing = range_bearing(pose, place)
    # 0, or NaN where the distance is 0: numba has no np.where for numbers
    defined = np.minimum(np.inf * (distance > 0.0), 0.0)
    return distance + defined, bearing + defined


def range_and_bearing(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return range and bearing of a landmark, with the sensor's bias."""
    distance, bearing = sight(pose, landmark)
    return distance + parameters.bias_range_m, bearing + parameters.bias_bearing_rad


def range_alone(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return the range alone."""
    return (range_and_bearing(pose, landmark, parameters)[0],)


def bearing_alone(pose: Components, landmark: Components, parameters: Any) -> Components:
    """Return the bearing alone."""
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
    """Return where the antenna is."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    forward, left = parameters.lever_x_m, parameters.lever_y_m
    return pose[0] + cosine * forward - sine * left, pose[1] + sine * forward + cosine * left


def fix_noise(parameters: Any) -> Components:
    """Return the variances of a fix that does not state them."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2


def pose_itself(pose: Components, reference: Any, parameters: Any) -> Components:
    """Return the pose itself."""
    return pose[0], pose[1], pose[2]


def pose_noise(parameters: Any) -> Components:
    """Return the variances of a pose that does not state them."""
    return parameters.sigma_fix_m**2, parameters.sigma_fix_m**2, parameters.sigma_heading_rad**2


def heading_alone(pose: Components, reference: Any, parameters: Any) -> Components:
    """Return the heading alone, with the sensor's bias."""
    return (pose[2] + parameters.bias_heading_rad,)


def heading_noise(parameters: Any) -> Components:
    """Return the variance of a heading that does not state it."""
    return (parameters.sigma_heading_rad**2,)


def read_pose(stream: Stream) -> Floats:
    """Return poses in the plane (n, 3) of those in space."""
    return np.column_stack([stream["position_m"][:, :2], heading(stream["quaternion"])])


def read_pose_covariance(stream: Stream) -> Floats:
    """Return the covariances (n, 3, 3) of poses: x, y and a turn about z, of the frame's axes."""
    return stream["covariance"].reshape(-1, 6, 6)[:, PLANAR][:, :, PLANAR]


def read_heading(stream: Stream) -> Floats:
    """Return the headings (n, 1) of orientations."""
    return heading(stream["quaternion"])[:, None]


def read_heading_covariance(stream: Stream) -> Floats:
    """Return their variances (n, 1, 1), which the channel states for all, about x, y and z."""
    return np.full((len(stream), 1, 1), heading_variance(stream.metadata))


def align(
    path: Floats, places: Floats, covariances: Floats, span_s: float, parameters: Any
) -> tuple[Floats, Floats] | None:
    """Find the pose at the last of some fixes: the antenna's path turned and shifted to them.

    By least squares. To its covariance is added what the odometry errs by: the mean of a random walk
    over a span, seen from its end, has a third of the variance that it has grown to.

    Args:
        path: poses (k, 3) where the odometry alone leads from zero, at the fixes.
        places, covariances: of the fixes, (k, 2) in m, (k, 2, 2).
        span_s: the time from the first to the last of them.
        parameters: with the antenna's place and the odometry's noise densities.

    Returns:
        The pose (3,) and its covariance (3, 3), or None while the heading is less sure than
        `COURSE_SIGMA_RAD`. See `start.Start`.
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
    """Turn rates about the vertical (n, 1) of a gyro that is mounted upright."""
    return stream["turn_rate_radps"][:, 2:]


COURSE_SIGMA_RAD = 0.1  # of a heading that is good enough to linearise at
PLANAR = [0, 1, 5]  # x, y and the turn about z among the six of a pose
RANGE: Mapping[str, Kind] = {"range_m": "linear"}
BEARING: Mapping[str, Kind] = {"bearing_rad": "angle"}
DRIVE_ERRORS: Mapping[str, Kind] = {"forward_scale": "linear", "turn_bias_radps": "linear"}
SIGHT_ERRORS: Mapping[str, Kind] = {"bias_range_m": "linear", "bias_bearing_rad": "angle"}
COMPASS_ERRORS: Mapping[str, Kind] = {"bias_heading_rad": "angle"}
LEVER: Mapping[str, Kind] = {"lever_x_m": "linear", "lever_y_m": "linear"}
# How well each needs to be known before it is said to be: 1 %, 1 % of a radian per second, 20 cm, 50 ms.
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
# Of logs that were not made for this model: wheels that slip as an indoor robot's may.
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
RECKONING = Model(
    "robot pose from odometry alone",
    POSE,
    DeadReckoningParameters,
    (),
    MOTION,
    control=ODOMETRY,
    output="pose",
    needs_sensor=False,
    augmentable=DRIVE_ERRORS,
    start=START,
    takes_fixes=False,
)
DEAD_RECKONING = modelled(RECKONING, "ekf")
