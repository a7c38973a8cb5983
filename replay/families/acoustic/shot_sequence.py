"""Model `moving-shooter`, which locates a moving shooter from all shots so far.

A report contains the muzzle blast's direction of arrival, the bullet's direction derived from the
shockwave, and the shockwave's lead, that is, the time from the shockwave to the muzzle blast. All of
them refer to the shooter's position at the time of the shot, not at the arrival of the sound. Reports
may be wrong, because of an echo or a shockwave of another shot. Gaussian methods treat a report as
entirely right or entirely wrong (see `fuselog.replay.inference.linear_algebra.inflation`); `particles:N`
treats each component separately.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.models import azimuth_range, fired_from
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.planar import Components, wrap_angle
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.estimators.localization.rays import intersect_rays
from fuselog.replay.inference.linear_algebra.gaussian import LOG_TWO_PI
from fuselog.replay.inference.model.model import Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start, Started

_NS = 1e-9
HALF_TURN = float(np.pi)
# Residuals of candidates for the start are clipped at this number of standard deviations.
CUT = 3.0


class MovingShooterParameters(ModelParameters):
    """Noise of motion and sensors, properties of sound and bullet, and search for the initial state.

    Attributes:
        acceleration_density: noise of the shooter's acceleration, in m/s^2/sqrt(Hz).
        trajectory_density: random walk of the direction of shots, in rad/sqrt(s).
        sigma_muzzle_blast_rad: standard deviation of the angle at which a sensor hears the muzzle blast.
        sigma_shockwave_rad: standard deviation of the angle at which a sensor hears the shockwave.
        sigma_time_difference_s: standard deviation of the time between shockwave and muzzle blast.
        speed_of_sound_mps: speed of sound in the air.
        mach_number: speed of the bullet, as a multiple of the speed of sound.
        outlier_probability: probability that a component of a report is wrong and may have any value;
            only `particles:N` uses it.
        longest_s: longest time between shockwave and muzzle blast in a wrong report.
        start_s: time span of the first reports, from which the initial state is found.
        start_sigma_m: standard deviation of the position at the start, per axis.
        start_sigma_mps: standard deviation of the velocity at the start, per axis.
        start_sigma_rad: standard deviation of the direction of shots at the start.
    """

    acceleration_density: NonNegativeFloat | None = None
    trajectory_density: NonNegativeFloat | None = None
    sigma_muzzle_blast_rad: PositiveFloat | None = None
    sigma_shockwave_rad: PositiveFloat | None = None
    sigma_time_difference_s: PositiveFloat | None = None
    speed_of_sound_mps: PositiveFloat | None = None
    mach_number: Annotated[float, Field(gt=1)] | None = None
    outlier_probability: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    longest_s: PositiveFloat = 1.0
    start_s: PositiveFloat = 1.0
    start_sigma_m: PositiveFloat = 20.0
    start_sigma_mps: PositiveFloat = 1.0
    start_sigma_rad: PositiveFloat = 0.3


def move(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Predict position, direction of shots and velocity, assuming constant velocity."""
    x, y, trajectory, vx, vy = state
    return x + duration_s * vx, y + duration_s * vy, trajectory, vx, vy


def move_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Compute the rows of the lower triangle of the process noise covariance."""
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, duration_s)
    aim = parameters.trajectory_density**2 * duration_s
    # fmt: off
    return (
        place,
        0.0, place,
        0.0, 0.0, aim,
        mixed, 0.0, 0.0, speed,
        0.0, mixed, 0.0, 0.0, speed,
    )
    # fmt: on


def hear(state: Components, sensor: Components, parameters: Any) -> Components:
    """Compute the muzzle blast's direction of arrival, the bullet's direction, and the shockwave's lead.

    There are two leads, one for each side of the line of fire; the report of a sensor uses the lead of
    the sensor's side. Each of the two is smooth across the line of fire, where the true lead has a kink.
    """
    x, y, trajectory, vx, vy = state
    speed = parameters.speed_of_sound_mps
    azimuth, distance = azimuth_range(fired_from((x, y), (vx, vy), sensor, speed), sensor)
    off_line = wrap_angle(azimuth - HALF_TURN - trajectory)
    widest = np.arccos(1.0 / parameters.mach_number)
    left = distance * (1.0 - np.cos(widest - off_line)) / speed
    right = distance * (1.0 - np.cos(widest + off_line)) / speed
    return azimuth, trajectory, left, right


def hear_noise(parameters: Any) -> Components:
    """Return the variances of a report's components."""
    return (
        parameters.sigma_muzzle_blast_rad**2,
        parameters.sigma_shockwave_rad**2,
        parameters.sigma_time_difference_s**2,
        parameters.sigma_time_difference_s**2,
    )


def log_likelihood(
    state: Components, measured: Components, sensor: Components, parameters: Any
) -> float:
    """Compute the log-likelihood of a report; each component may be an outlier with any value."""
    azimuth, trajectory, left, right = hear(state, sensor, parameters)
    turn, longest, share = 2.0 * HALF_TURN, parameters.longest_s, parameters.outlier_probability
    lead_s = parameters.sigma_time_difference_s
    blast, bullet = wrap_angle(measured[0] - azimuth), wrap_angle(measured[1] - trajectory)
    return (
        _log_mixture(blast, parameters.sigma_muzzle_blast_rad, turn, share)
        + _log_mixture(bullet, parameters.sigma_shockwave_rad, turn, share)
        + _log_mixture(measured[2] - left, lead_s, longest, share)
        + _log_mixture(measured[3] - right, lead_s, longest, share)
    )


def _log_mixture(deviation: float, sigma: float, span: float, share: float) -> float:
    """Compute the log density of a Gaussian mixed with a uniform density, or 0 for a NaN deviation."""
    if np.isnan(deviation):
        return 0.0
    gaussian = -0.5 * (deviation / sigma) ** 2 - np.log(sigma) - 0.5 * LOG_TWO_PI
    return np.logaddexp(np.log1p(-share) + gaussian, np.log(share / span))


def find_shooter(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find the shot that fits most of the first reports.

    Candidates are all points where the directions of two muzzle blasts intersect, each combined with
    every reported direction of the bullet. A least-squares fit with Cauchy loss starts from the
    candidate with the smallest residuals, which are clipped at three standard deviations. The fit
    suppresses wrong reports if most reports are right. Raises BadInput if the reports do not determine a
    shot.
    """
    reports, sensors = streams["reports"], streams[SENSORS.topic]
    places = dict(zip(sensors["landmark_id"].tolist(), sensors["position_m"][:, :2], strict=True))
    known = reports.take(np.isin(reports["sensor_id"], sensors["landmark_id"]))
    heard = np.stack([known[name] for name in HEARD], axis=1)
    reference = np.array([places[sensor] for sensor in known["sensor_id"].tolist()]).reshape(-1, 2)
    time_ns = known.publish_time_ns
    ends = np.searchsorted(time_ns, time_ns + round(parameters.start_s / _NS), side="right")
    for begin, end in enumerate(ends.tolist()):
        shot = _best_shot(heard[begin:end], reference[begin:end], parameters)
        if shot is not None:
            sigma = np.repeat(
                [parameters.start_sigma_m, parameters.start_sigma_rad, parameters.start_sigma_mps],
                [2, 1, 2],
            )
            mean = np.append(shot, [0.0, 0.0])
            return Started(
                int(time_ns[begin]), mean, np.diag(sigma**2), "at the best fit to its first shot"
            )
    raise BadInput(
        f"topic {reports.topic}: no span of {parameters.start_s:g} s has a shockwave and two muzzle "
        f"blasts whose directions from sensors of {SENSORS.topic} intersect; use a longer start_s, or "
        "add a prior to the log"
    )


def _best_shot(heard: Floats, sensors: Floats, parameters: Any) -> Floats | None:
    """Fit position and direction (3,) of a shot to reports (n, 4) of sensors (n, 2); None on failure."""
    sigma = np.sqrt(np.array(hear_noise(parameters)))

    def residuals(shot: Floats) -> Floats:
        x, y, trajectory = shot
        still = np.zeros_like(x)
        predicted = hear((x, y, trajectory, still, still), sensors.T, parameters)
        off = heard - np.stack(np.broadcast_arrays(*predicted), axis=-1)
        off[..., :2] = wrap_angle(off[..., :2])
        return np.nan_to_num(off / sigma)

    unit = np.stack([np.cos(heard[:, 0]), np.sin(heard[:, 0])], axis=1)
    pairs = np.array(list(combinations(range(len(heard)), 2)), np.intp).reshape(-1, 2)
    meeting = intersect_rays(sensors[pairs], unit[pairs])
    meeting = meeting[np.isfinite(meeting).all(axis=1)]
    aims = heard[np.isfinite(heard[:, 1]), 1]
    if not (len(meeting) and len(aims)):
        return None
    tried = np.column_stack([np.repeat(meeting, len(aims), axis=0), np.tile(aims, len(meeting))])
    cut = np.minimum(residuals(tried.T[..., None]) ** 2, CUT**2).sum(axis=(1, 2))
    start = tried[np.argmin(cut)]
    from scipy.optimize import least_squares  # slow to import

    return least_squares(lambda shot: residuals(shot).ravel(), start, loss="cauchy").x


SENSORS = Map("/sensors", schemas.LANDMARK, "landmark_id", "position_m", PLANE, "sensor_id")
HEARD: Components = {
    "muzzle_blast_azimuth_rad": "angle",
    "trajectory_rad": "angle",
    "left_lead_s": "linear",
    "right_lead_s": "linear",
}
# Default for logs that do not state it: a person on foot.
ASSUMED = {"acceleration_density": 0.1, "trajectory_density": 0.05}
MOVING_SHOOTER = Model(
    "a moving shooter, from the shots that acoustic sensors hear",
    {
        "x_m": "linear",
        "y_m": "linear",
        "trajectory_rad": "angle",
        "vx_mps": "linear",
        "vy_mps": "linear",
    },
    MovingShooterParameters,
    (
        Sensor(
            "reports",
            schemas.SHOT_REPORT,
            HEARD,
            hear,
            hear_noise,
            reference=SENSORS,
            log_likelihood=log_likelihood,
        ),
    ),
    Motion(move, move_noise, linear=True),
    start=Start({}, ASSUMED, find=find_shooter),
    augmentable={"speed_of_sound_mps": "linear"},
    takes_fixes=False,
)
