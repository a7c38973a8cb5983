"""Alignment of inertial navigation: tilt from samples at rest, heading from the course.

Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2013,
section 5.6: roll and pitch are computed from the specific force, which equals gravity if the body does
not accelerate; the bias of the gyro is its mean at rest; the heading is the first course at sufficient
speed. Standard deviations that are not given are estimated from the same samples.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.inertial import (
    EARTH_RATE_RADPS,
    from_mounting,
    into_body,
    into_plane,
    product,
    rotation,
)
from fuselog.recorders.models.planar import Components, wrap_angle
from fuselog.recorders.models.states import NAVIGATION
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.measurements import SPACE, read_fixes
from fuselog.replay.engine.vectors.components import components_of
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Started
from fuselog.replay.inference.run.first_messages import WIDER

LEAP_SECONDS, LEAP_MARGIN_S = 18, 2.0  # between UTC and GPS time since 2017; tolerance of its detection
SMALLEST_CHANGE_MPS2 = 0.2  # of the specific force, when the body starts to move
LARGEST_BIAS_RADPS = 0.1  # three times the bias of the cheapest units
USUAL_BIAS_RADPS = 0.0035  # standard deviation for a small unit that was never at rest
SIDEWAYS_RAD, ALIKE = (
    np.radians(60.0),
    0.8,
)  # reported angle of accelerations; correlation

USUAL_SIGMA_M, USUAL_SIGMA_MPS = 10.0, 0.5  # for receivers that do not state their accuracy
VELOCITY = components_of(NAVIGATION[3:6])
NS = 1e-9


class ImuSamples(NamedTuple):
    """Samples of an inertial unit in body axes: times (n,), specific forces and turn rates (n, 3)."""

    time_ns: Integers
    force: Floats
    rate: Floats


class GnssMotion(NamedTuple):
    """Velocities (n, 3) of a receiver, their covariances (n, 3, 3) and times of measurement (n,)."""

    topic: str
    time_ns: Integers
    mps: Floats
    covariance: Floats

    def first_above(self, row: int, limit_mps: float) -> int | None:
        """Return the first row, from `row` on, whose horizontal speed exceeds the limit."""
        faster = np.flatnonzero(np.hypot(*self.mps[row:, :2].T) > limit_mps)
        return row + int(faster[0]) if len(faster) else None


def mounted(sample: Any, parameters: Any) -> Any:
    """Rotate one measurement of the unit, or columns of measurements, to the body's axes."""
    roll, pitch = parameters.mounting_roll_rad, parameters.mounting_pitch_rad
    return from_mounting(roll, pitch, parameters.mounting_yaw_rad, sample)


def read_samples(inertial: Stream, parameters: Any) -> ImuSamples:
    """Return the finite samples with their times of measurement."""
    columns = [
        np.stack(mounted(inertial[name].T, parameters), axis=1)
        for name in ("specific_force_mps2", "turn_rate_radps")
        if len(inertial)
    ]
    finite = np.isfinite(np.hstack(columns)).all(axis=1) if columns else np.zeros(0, bool)
    if not finite.any():
        raise BadInput(
            f"topic {inertial.topic}: no sample has both specific force and turn rate, which the start "
            "needs"
        )
    time_ns = inertial.publish_time_ns[finite] - round(parameters.inertial_delay_s / NS)
    force, rate = (column[finite] for column in columns)
    return ImuSamples(time_ns, force, rate)


def stated_or(sigma: float | None, otherwise: Any) -> Any:
    """Return a parameter, or `otherwise` if it is None or NaN."""
    return otherwise if sigma is None or np.isnan(sigma) else sigma


def read_motion(streams: Mapping[str, Stream], parameters: Any) -> GnssMotion | None:
    """Return the finite velocities, or None if no velocity is finite."""
    stream = streams.get("velocity")
    if stream is None:
        return None
    sigma = stated_or(parameters.sigma_velocity_mps, USUAL_SIGMA_MPS)
    found = read_fixes(stream, "velocity_mps", "covariance_m2ps2", VELOCITY, sigma)
    finite = np.isfinite(found.value).all(axis=1)
    if not finite.any():
        return None
    time_ns = stream.publish_time_ns - round(parameters.velocity_delay_s / NS)
    return GnssMotion(stream.topic, time_ns[finite], found.value[finite], found.covariance[finite])


PLUMB_SIGMA_RAD = 1e-4  # deflection of the plumb line from the ellipsoid's normal


def unsteadiness(samples: ImuSamples, motion: GnssMotion | None, parameters: Any) -> float:
    """Compute the standard deviation, in m/s2, of the mean specific force of the first samples.

    It includes the spread of the samples and the change of the velocity during this time.
    """
    begin_ns = samples.time_ns[0]
    until_ns = begin_ns + round(parameters.level_s / NS)
    spread = samples.force[samples.time_ns < until_ns].std(axis=0)
    changed = np.zeros(3)
    if motion is not None:
        ends = np.interp([begin_ns, until_ns], motion.time_ns, np.arange(len(motion.time_ns)))
        first, last = np.rint(ends).astype(int)
        changed = (motion.mps[last] - motion.mps[first]) / parameters.level_s
    plumb = PLUMB_SIGMA_RAD * STANDARD_GRAVITY_MPS2
    return float(np.sqrt(np.mean(spread**2) + np.mean(changed[:2] ** 2) + plumb**2))


class AlignmentParameters(ModelParameters):
    """Mounting and delay of the unit, and settings of the search for the initial state.

    The tilt is computed from the first samples. The body is assumed to be at rest until shortly before
    it first moves (`rest_margin_s`). The heading is the course at the first sufficient speed, minus the
    rotation that the gyro measured until then; without such a speed, the heading is unknown. Standard
    deviations of the start that are not given are estimated from the data. Position and velocity are
    made so uncertain that their first messages determine them. The uncertainty of the tilt follows from
    the accelerometer's bias and the motion, the uncertainty of the gyro's bias from its mean at rest,
    and the uncertainty of the heading from the differences between the course and the rotation that the
    gyro measured.

    The mounting rotates the unit's axes to forward, left, up: by yaw about up, then pitch about left,
    then roll about forward. An axis measures (1 + scale) times the true value, plus the bias.

    Attributes:
        mounting_roll_rad, mounting_pitch_rad, mounting_yaw_rad: angles of the mounting.
        force_scale_x, force_scale_y, force_scale_z: how much the measured force exceeds the true force,
            as a fraction of the true force, per axis.
        gyro_scale_x, gyro_scale_y, gyro_scale_z: how much the measured rate exceeds the true rate, as a
            fraction of the true rate, per axis.
        fix_delay_s: delay of position fixes: time from the measurement to the stamp.
        velocity_delay_s: delay of velocities: time from the measurement to the stamp.
        inertial_delay_s: delay of inertial samples: time from the measurement to the stamp.
        level_s: duration of the first samples, from which the tilt is computed.
        still_mps: speed above which the body is considered to be moving.
        rest_margin_s: the body is assumed to be at rest until this time before its first motion.
        course_mps: speed above which the course determines the heading.
        course_s: duration over which courses are compared with the rotation that the gyro measured, to
            estimate the heading's standard deviation.
        start_sigma_m: standard deviation of the position at the start, per axis.
        start_sigma_mps: standard deviation of a measured velocity at the start, per axis.
        unmeasured_sigma_mps: standard deviation of the velocity at the start if it is not measured, per
            axis.
        tilt_sigma_rad: standard deviation of roll and pitch at the start.
        heading_sigma_rad: standard deviation of the heading at the start.
        gyro_bias_sigma_radps: standard deviation of the gyro's bias at the start, per axis.
        force_bias_sigma_mps2: standard deviation of the accelerometer's bias at the start, per axis.
    """

    mounting_roll_rad: float = 0.0
    mounting_pitch_rad: float = 0.0
    mounting_yaw_rad: float = 0.0
    force_scale_x: float = 0.0
    force_scale_y: float = 0.0
    force_scale_z: float = 0.0
    gyro_scale_x: float = 0.0
    gyro_scale_y: float = 0.0
    gyro_scale_z: float = 0.0
    fix_delay_s: float = 0.0
    velocity_delay_s: float = 0.0
    inertial_delay_s: float = 0.0
    level_s: PositiveFloat = 1.0
    still_mps: PositiveFloat = 0.2
    rest_margin_s: NonNegativeFloat = 1.0
    course_mps: PositiveFloat = 1.0
    course_s: PositiveFloat = 10.0
    start_sigma_m: PositiveFloat | None = None
    start_sigma_mps: PositiveFloat | None = None
    unmeasured_sigma_mps: PositiveFloat = 10.0
    tilt_sigma_rad: PositiveFloat | None = None
    heading_sigma_rad: PositiveFloat | None = None
    gyro_bias_sigma_radps: PositiveFloat | None = None
    force_bias_sigma_mps2: PositiveFloat = 0.3


def specific_force(samples: Any, bias: Any, parameters: Any) -> Any:
    """Return the body's specific force, given a sample of the unit (force, rate) and the bias."""
    x, y, z = mounted(samples[:3], parameters)
    sx, sy, sz = parameters.force_scale_x, parameters.force_scale_y, parameters.force_scale_z
    return (x - bias[0]) / (1.0 + sx), (y - bias[1]) / (1.0 + sy), (z - bias[2]) / (1.0 + sz)


def turn_rate(samples: Any, bias: Any, parameters: Any) -> Any:
    """Return the body's turn rate, given a sample of the unit and the bias; see `specific_force`."""
    x, y, z = mounted(samples[3:], parameters)
    sx, sy, sz = parameters.gyro_scale_x, parameters.gyro_scale_y, parameters.gyro_scale_z
    return (x - bias[0]) / (1.0 + sx), (y - bias[1]) / (1.0 + sy), (z - bias[2]) / (1.0 + sz)


def align(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find the initial state from the first fix during the samples and the velocity nearest in time.

    Args:
        streams: streams: `inertial` (samples), `fix` (positions in the local tangent plane: east, north,
            up), and optionally `velocity` (velocities in that plane).
        parameters: `AlignmentParameters`.

    Raises BadInput if there is no such fix, if the inertial unit does not measure gravity, or if values
    seem to be in another physical unit.
    """
    samples, topic = read_samples(streams["inertial"], parameters), streams["inertial"].topic
    if "fix" not in streams:
        raise BadInput(f"{topic} has no position to start from; give a topic of position fixes")
    start_ns, place, spread = _first_place(streams["fix"], samples, topic, parameters)
    motion, how = read_motion(streams, parameters), "levelled, with an unknown heading"
    mean, covariance = np.zeros(16), np.zeros((15, 15))
    mean[:3], covariance[:3, :3] = place, _wide(parameters.start_sigma_m, spread)
    covariance[3:6, 3:6] = parameters.unmeasured_sigma_mps**2 * np.eye(3)
    roll, pitch = _tilt(samples, topic, parameters)
    tilted = product(rotation(0.0, pitch, 0.0), rotation(roll, 0.0, 0.0))
    heading, heading_sigma, bias_sigma = 0.0, np.pi, USUAL_BIAS_RADPS
    if motion is not None:
        row = int(np.argmin(np.abs(motion.time_ns - start_ns)))
        spread = motion.covariance[row]
        mean[3:6], covariance[3:6, 3:6] = motion.mps[row], _wide(parameters.start_sigma_mps, spread)
        mean[10:13], bias_sigma = _bias(samples, topic, motion, row, parameters)
        turning = _turned(samples, start_ns, tilted, mean[10:13])
        found = _heading(turning, start_ns, motion, row, parameters)
        if found is not None:
            heading, heading_sigma = found[0], stated_or(parameters.heading_sigma_rad, found[1])
            how = "levelled, with the course as its heading"
            how += _mounting(samples, turning, start_ns, motion, tilted, heading, parameters)
        how += _leap(samples, motion, row, parameters)
    mean[6:10] = product(rotation(0.0, 0.0, heading), tilted)
    up = np.array(into_body(mean[6:10], (0.0, 0.0, 1.0)))
    covariance[9:12, 9:12] = stated_or(parameters.gyro_bias_sigma_radps, bias_sigma) ** 2 * np.eye(3)
    unsteadiness_mps2 = unsteadiness(samples, motion, parameters)
    tilts = np.ix_([6, 7, 8, 12, 13, 14], [6, 7, 8, 12, 13, 14])
    covariance[tilts] = _tilt_covariance(up, unsteadiness_mps2, parameters)
    covariance[6:9, 6:9] += heading_sigma**2 * np.outer(up, up)
    return Started(start_ns, mean, covariance, how)


def check_prior(streams: Mapping[str, Stream], parameters: Any) -> list[str]:
    """Describe apparent errors in the first samples of a body whose initial state is known.

    The checks are the same as in `align`, but raise no exception, because the body may start in motion.

    Args:
        streams: see `align`.
        parameters: `AlignmentParameters`.
    """
    topic, found = streams["inertial"].topic, []
    if not len(streams["inertial"]):
        return []
    try:
        samples = read_samples(streams["inertial"], parameters)
        _tilt(samples, topic, parameters)
    except BadInput as error:
        return [str(error)]
    motion = read_motion(streams, parameters)
    if motion is not None:
        try:
            _bias(samples, topic, motion, 0, parameters)
        except BadInput as error:
            found.append(str(error))
        found.append(_leap(samples, motion, 0, parameters).removeprefix("; "))
    return [each for each in found if each]


def _wide(sigma: float | None, covariance: Floats) -> Floats:
    """Return a wide initial covariance (3, 3); its message is also used as a measurement."""
    given = stated_or(sigma, None)
    return WIDER**2 * covariance if given is None else given**2 * np.eye(3)


def _tilt_covariance(up: Floats, unsteadiness_mps2: float, parameters: Any) -> Floats:
    """Return the covariance (6, 6) of tilt and accelerometer bias in body axes; `up` is vertical.

    If the tilt's standard deviation is not given, tilt and bias are correlated: levelling mistakes a
    bias for a tilt, so the error of the tilt is the ratio of the bias to gravity.
    """
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = force = parameters.force_bias_sigma_mps2**2 * np.eye(3)
    tilt_sigma = stated_or(parameters.tilt_sigma_rad, None)
    if tilt_sigma is not None:
        covariance[:3, :3] = tilt_sigma**2 * (np.eye(3) - np.outer(up, up))
        return covariance
    lean = np.cross(up, np.eye(3)).T / STANDARD_GRAVITY_MPS2
    covariance[:3, :3] = lean @ (force + unsteadiness_mps2**2 * np.eye(3)) @ lean.T
    covariance[:3, 3:] = lean @ force
    covariance[3:, :3] = covariance[:3, 3:].T
    return covariance


def _first_place(
    fix: Stream, samples: ImuSamples, topic: str, parameters: Any
) -> tuple[int, Floats, Floats]:
    """Return time, position (3,) and covariance (3, 3) of the first fix within the samples.

    A fix without a height has the height of the origin. Raises BadInput if there is no such fix.
    """
    sigma = stated_or(parameters.sigma_fix_m, USUAL_SIGMA_M)
    places = read_fixes(fix, "position_m", "covariance_m2", SPACE, sigma)
    time_ns = fix.publish_time_ns - round(parameters.fix_delay_s / NS)
    within = (time_ns >= samples.time_ns[0]) & (time_ns <= samples.time_ns[-1])
    usable = np.flatnonzero(within & np.isfinite(places.value[:, :2]).all(axis=1))
    if not len(usable):
        later_s = (time_ns[0] - samples.time_ns[0]) * NS if len(fix) else np.nan
        raise BadInput(
            f"no message of {fix.topic} is within the time span of {topic}; {fix.topic} starts "
            f"{later_s:.3g} s later; if their clocks differ, correct them by fix_delay_s or "
            "inertial_delay_s"
        )
    first = usable[0]
    return int(time_ns[first]), np.nan_to_num(places.value[first]), places.covariance[first]


def _tilt(samples: ImuSamples, topic: str, parameters: Any) -> tuple[float, float]:
    """Compute roll and pitch, in rad, for which the mean of the first specific forces points up.

    Raises BadInput if the mean does not have the magnitude of gravity in m/s2, or points down.
    """
    until_ns = samples.time_ns[0] + round(parameters.level_s / NS)
    x, y, z = samples.force[samples.time_ns < until_ns].mean(axis=0)
    length = float(np.sqrt(x * x + y * y + z * z))
    if not 0.8 * STANDARD_GRAVITY_MPS2 < length < 1.25 * STANDARD_GRAVITY_MPS2:
        in_g = "; the unit looks like g: import the topic with that unit" if 0.8 < length < 1.25 else ""
        raise BadInput(
            f"topic {topic}: the specific force is {length:.3g} m/s2 in the first "
            f"{parameters.level_s:g} s; expected gravity, 9.8 m/s2{in_g}"
        )
    if z < -0.5 * length:
        raise BadInput(
            f"topic {topic}: the specific force of the first {parameters.level_s:g} s points down "
            f"(z = {z:.3g} m/s2); if the unit is mounted upside down, give mounting_roll_rad=3.14159"
        )
    return float(np.arctan2(y, z)), float(np.arctan2(-x, np.hypot(y, z)))


def _bias(
    samples: ImuSamples, topic: str, motion: GnssMotion, row: int, parameters: Any
) -> tuple[Floats, float]:
    """Return the mean turn rate (3,) at rest, or zeros if never at rest, and its standard deviation.

    The standard deviation is computed from the rotation of the earth and from the means over intervals
    of `level_s`, which differ because of noise and motion.

    Raises BadInput if the mean rate is larger than the bias of any gyro.
    """
    moved = motion.first_above(row, parameters.still_mps)
    end_ns = samples.time_ns[-1] if moved is None else motion.time_ns[moved]
    at_rest = samples.time_ns < end_ns - round(parameters.rest_margin_s / NS)
    if not at_rest.any():
        return np.zeros(3), USUAL_BIAS_RADPS
    bias = samples.rate[at_rest].mean(axis=0)
    largest = float(np.abs(bias).max())
    if largest > LARGEST_BIAS_RADPS:
        raise BadInput(
            f"topic {topic}: the mean turn rate at rest is {largest:.3g} rad/s, more than the bias of "
            "any gyro; the unit looks like deg/s: import the topic with that unit"
        )
    since_s = (samples.time_ns[at_rest] - samples.time_ns[0]) * NS
    _, stretch, count = np.unique(since_s // parameters.level_s, return_inverse=True, return_counts=True)
    if len(count) < 3:
        return bias, USUAL_BIAS_RADPS
    means = np.stack([np.bincount(stretch, each) for each in samples.rate[at_rest].T]) / count
    sigma = means.var(axis=1, ddof=1).mean() / len(count)
    return bias, float(np.sqrt(sigma + EARTH_RATE_RADPS**2))


def _leap(samples: ImuSamples, motion: GnssMotion, row: int, parameters: Any) -> str:
    """Report if the unit and the fixes start to move at times that differ by the leap seconds of GPS."""
    moved = motion.first_above(row, parameters.still_mps)
    level = samples.time_ns < samples.time_ns[0] + round(parameters.level_s / NS)
    if moved is None:
        return ""
    change = samples.force - samples.force[level].mean(axis=0)
    noise = 5.0 * change[level].std(axis=0) + SMALLEST_CHANGE_MPS2
    sets_off = np.flatnonzero((np.abs(change) > noise).any(axis=1))
    if not len(sets_off):
        return ""
    later_s = float(motion.time_ns[moved] - samples.time_ns[sets_off[0]]) * NS
    if abs(abs(later_s) - LEAP_SECONDS) > LEAP_MARGIN_S:
        return ""
    shift_s = np.copysign(LEAP_SECONDS, -later_s) + parameters.inertial_delay_s
    return (
        f"; {motion.topic} starts to move {later_s:.3g} s after the unit; if their clocks differ by the "
        f"{LEAP_SECONDS} leap seconds between GPS time and UTC, give inertial_delay_s={shift_s:g}"
    )


def _turned(
    samples: ImuSamples, start_ns: int, tilted: Components, bias: Floats
) -> tuple[Floats, Floats]:
    """Return later samples' times (n,) in s since the start, and the rotation about the vertical."""
    since = samples.time_ns >= start_ns
    since_s = np.asarray((samples.time_ns[since] - start_ns) * NS, float)
    up = np.array(into_body(tilted, (0.0, 0.0, 1.0)))
    rate = (samples.rate[since] - bias) @ up
    return since_s, _integral(rate, since_s)


def _integral(values: NDArray, times_s: Floats) -> NDArray:
    """Integrate values (n,) from the first time on, by the trapezoidal rule."""
    from scipy.integrate import cumulative_trapezoid  # slow to import

    return np.asarray(cumulative_trapezoid(values, times_s, initial=0.0))


def _heading(
    turning: tuple[Floats, Floats], start_ns: int, motion: GnssMotion, row: int, parameters: Any
) -> tuple[float, float] | None:
    """Find the heading at the start and its standard deviation in rad, or None without motion.

    The heading is the first course, minus the body's rotation about the vertical axis until then. If the
    body faces its direction of motion, all later courses give the same heading; their differences
    determine the standard deviation.
    """
    fast = motion.first_above(row, parameters.course_mps)
    if fast is None:
        return None
    until_ns = motion.time_ns[fast] + round(parameters.course_s / NS)
    rows = np.arange(fast, np.searchsorted(motion.time_ns, until_ns))
    rows = rows[np.hypot(*motion.mps[rows, :2].T) > parameters.course_mps]
    east, north, _ = motion.mps[rows].T
    heading = np.arctan2(north, east) - np.interp((motion.time_ns[rows] - start_ns) * NS, *turning)
    apart = wrap_angle(heading - heading[0])
    noise = motion.covariance[fast, :2, :2].trace() / 2.0 / (east[0] ** 2 + north[0] ** 2)
    return float(heading[0]), float(min(np.sqrt(np.mean(apart**2) + noise), np.pi))


def _mounting(
    samples: ImuSamples,
    turning: tuple[Floats, Floats],
    start_ns: int,
    motion: GnssMotion,
    tilted: Components,
    heading: float,
    parameters: Any,
) -> str:
    """Report if the measured acceleration and the change of the velocity have different directions.

    The horizontal components are compared, as complex numbers, over the intervals between velocities.
    """
    since_s, turned = turning
    fast = motion.first_above(0, parameters.course_mps)
    end_s = since_s[-1] if fast is None else (motion.time_ns[fast] - start_ns) * NS + parameters.course_s
    stamps_s = (motion.time_ns - start_ns) * NS
    rows = np.flatnonzero((stamps_s >= 0.0) & (stamps_s <= min(end_s, since_s[-1])))
    if len(rows) < 3:
        return ""
    ahead, left, _ = into_plane(tilted, samples.force[samples.time_ns >= start_ns].T)
    gained = _integral((ahead + 1j * left) * np.exp(1j * (heading + turned)), since_s)
    felt = np.diff(np.interp(stamps_s[rows], since_s, gained))
    seen = np.diff(motion.mps[rows, 0] + 1j * motion.mps[rows, 1])
    together = np.vdot(felt, seen)
    apart = float(np.angle(together))
    if abs(together) < ALIKE * np.linalg.norm(felt) * np.linalg.norm(seen) or abs(apart) < SIDEWAYS_RAD:
        return ""
    yaw = wrap_angle(parameters.mounting_yaw_rad + apart)
    return (
        f"; the velocity changes {np.degrees(abs(apart)):.0f} deg to the "
        f"{'left' if apart > 0 else 'right'} of the measured acceleration; if the unit is mounted "
        f"rotated, give mounting_yaw_rad={yaw:.2f}"
    )
