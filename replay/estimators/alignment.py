"""Where inertial navigation starts from: levelled at rest, its heading from the course.

Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2013,
section 5.6: roll and pitch from the specific force, of which gravity is all while nothing accelerates;
the gyro's bias from what it says at rest; the heading from the first course that is worth one.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from recorders.errors import BadInput
from recorders.log import Stream
from recorders.models.inertial import from_mounting, into_body, product, rotation
from replay.engine.arrays import Floats, Integers
from replay.inference.model import ModelParameters, Started

STANDARD_GRAVITY_MPS2 = 9.80665
LEAP_SECONDS, LEAP_MARGIN_S = 18, 2.0  # between UTC and GPS time since 2017; how exactly it shows
SMALLEST_CHANGE_MPS2 = 0.2  # of the specific force: the body sets off
LARGEST_BIAS_RADPS = 0.1  # of the cheapest units it is a third of that
_NS = 1e-9


class AlignmentParameters(ModelParameters):
    """How the unit is mounted and delayed, and how the state at the start is found.

    Tilt comes from the first `level_s` seconds. The body is assumed to rest until `rest_margin_s`
    before it first moves faster than `still_mps`. The heading is the course at the first speed above
    `course_mps`, less the turn of the gyro until then; without such a speed it is unknown. The standard
    deviations of the start are `start_sigma_m` of the position, `start_sigma_mps` of a velocity that is
    measured and `unmeasured_sigma_mps` of one that is not, `tilt_sigma_rad`, `heading_sigma_rad`, and
    those of the biases.

    The mounting turns the unit's axes into forward, left, up: by yaw about up, then pitch about left,
    then roll about forward. An axis measures (1 + scale) times the true value, plus the bias. A message
    was measured its topic's delay before its stamp.
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
    start_sigma_m: PositiveFloat = 0.05
    start_sigma_mps: PositiveFloat = 0.1
    unmeasured_sigma_mps: PositiveFloat = 10.0
    tilt_sigma_rad: PositiveFloat = 0.05
    heading_sigma_rad: PositiveFloat = 0.35
    gyro_bias_sigma_radps: PositiveFloat = 0.0035
    force_bias_sigma_mps2: PositiveFloat = 0.3


class _Samples(NamedTuple):
    """A unit's samples in the body's axes: times (n,), specific force and turn rate (n, 3)."""

    time_ns: Integers
    force: Floats
    rate: Floats


def mounted(sample: Any, parameters: Any) -> Any:
    """What the unit measures, in the body's axes; three components, or columns of them."""
    roll, pitch = parameters.mounting_roll_rad, parameters.mounting_pitch_rad
    return from_mounting(roll, pitch, parameters.mounting_yaw_rad, sample)


def specific_force(samples: Any, bias: Any, parameters: Any) -> Any:
    """The specific force of the body by samples of the unit, force and rate, of this bias."""
    x, y, z = mounted(samples[:3], parameters)
    sx, sy, sz = parameters.force_scale_x, parameters.force_scale_y, parameters.force_scale_z
    return (x - bias[0]) / (1.0 + sx), (y - bias[1]) / (1.0 + sy), (z - bias[2]) / (1.0 + sz)


def turn_rate(samples: Any, bias: Any, parameters: Any) -> Any:
    """The turn rate of the body, see `specific_force`."""
    x, y, z = mounted(samples[3:], parameters)
    sx, sy, sz = parameters.gyro_scale_x, parameters.gyro_scale_y, parameters.gyro_scale_z
    return (x - bias[0]) / (1.0 + sx), (y - bias[1]) / (1.0 + sy), (z - bias[2]) / (1.0 + sz)


def align(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Where to start from: the first fix within the unit's samples, and the velocity nearest to it.

    Args:
        streams: `inertial` samples, `fix`, positions in the plane (east, north, up), and perhaps
            `velocity`, velocities there.
        parameters: `AlignmentParameters`.

    Raises BadInput where there is no such fix, no gravity to level by, or numbers of another unit.
    """
    samples = _samples(streams["inertial"], parameters)
    begin_ns = samples.time_ns[0]
    if "fix" not in streams:
        raise BadInput(
            f"no position is known from which {streams['inertial'].topic} could begin; give a topic of "
            "fixes"
        )
    fix, moving = streams["fix"], streams.get("velocity")
    fix_ns = fix.publish_time_ns - round(parameters.fix_delay_s / _NS)
    usable = (fix_ns >= begin_ns) & (fix_ns <= samples.time_ns[-1])
    if not usable.any():
        later_s = (fix_ns[0] - begin_ns) * _NS if len(fix) else np.nan
        raise BadInput(
            f"no message of {fix.topic} within the span of {streams['inertial'].topic}, and it begins "
            f"{later_s:.3g} s later; do their clocks agree? fix_delay_s and inertial_delay_s move them"
        )
    first = int(np.flatnonzero(usable)[0])
    tilt = _tilt(samples, streams["inertial"].topic, parameters)
    mean = np.concatenate([fix["position_m"][first], np.zeros(3), [1.0, 0.0, 0.0, 0.0], np.zeros(6)])
    sigma = np.repeat(
        [
            parameters.start_sigma_m,
            parameters.unmeasured_sigma_mps,
            parameters.tilt_sigma_rad,
            parameters.gyro_bias_sigma_radps,
            parameters.force_bias_sigma_mps2,
        ],
        3,
    )
    heading_sigma, heading, how = np.pi, 0.0, "levelled, its heading unknown"
    if moving is not None and len(moving):
        velocity_ns = moving.publish_time_ns - round(parameters.velocity_delay_s / _NS)
        row = int(np.argmin(np.abs(velocity_ns - fix_ns[first])))
        mean[3:6], sigma[3:6] = moving["velocity_mps"][row], parameters.start_sigma_mps
        mean[10:13] = _bias(samples, streams["inertial"].topic, moving, row, parameters)
        found = _heading(samples, int(fix_ns[first]), moving, row, tilt, mean[10:13], parameters)
        if found is not None:
            heading_sigma, heading = parameters.heading_sigma_rad, found
            how = "levelled, its heading the course"
        how += _leap(samples, moving, row, parameters)
    roll, pitch = tilt
    tilted = product(rotation(0.0, pitch, 0.0), rotation(roll, 0.0, 0.0))
    mean[6:10] = product(rotation(0.0, 0.0, heading), tilted)
    covariance, up = np.diag(sigma**2), np.array(into_body(mean[6:10], (0.0, 0.0, 1.0)))
    more = heading_sigma**2 - parameters.tilt_sigma_rad**2
    covariance[6:9, 6:9] += more * np.outer(up, up)
    return Started(int(fix_ns[first]), mean, covariance, how)


def suspect(streams: Mapping[str, Stream], parameters: Any) -> list[str]:
    """What looks wrong in the first samples of a body whose start is known.

    It is what `align` refuses, and only said here: the body may begin in motion.

    Args:
        streams: see `align`.
        parameters: `AlignmentParameters`.
    """
    topic, found = streams["inertial"].topic, []
    if not len(streams["inertial"]):
        return []
    try:
        samples = _samples(streams["inertial"], parameters)
        _tilt(samples, topic, parameters)
    except BadInput as error:
        return [str(error)]
    moving = streams.get("velocity")
    if moving is not None and len(moving):
        try:
            _bias(samples, topic, moving, 0, parameters)
        except BadInput as error:
            found.append(str(error))
        found.append(_leap(samples, moving, 0, parameters).removeprefix("; "))
    return [each for each in found if each]


def _samples(inertial: Stream, parameters: Any) -> _Samples:
    """The finite samples at the times at which they were measured."""
    columns = [
        np.stack(mounted(inertial[name].T, parameters), axis=1)
        for name in ("specific_force_mps2", "turn_rate_radps")
        if len(inertial)
    ]
    finite = np.isfinite(np.hstack(columns)).all(axis=1) if columns else np.zeros(0, bool)
    if not finite.any():
        raise BadInput(f"topic {inertial.topic}: has no samples to begin with")
    time_ns = inertial.publish_time_ns[finite] - round(parameters.inertial_delay_s / _NS)
    force, rate = (column[finite] for column in columns)
    return _Samples(time_ns, force, rate)


def _tilt(samples: _Samples, topic: str, parameters: Any) -> tuple[float, float]:
    """Roll and pitch, rad, under which the mean of the first specific forces points up.

    Raises BadInput where that is not gravity in m/s2, or points down.
    """
    until_ns = samples.time_ns[0] + round(parameters.level_s / _NS)
    x, y, z = samples.force[samples.time_ns < until_ns].mean(axis=0)
    length = float(np.sqrt(x * x + y * y + z * z))
    if not 0.8 * STANDARD_GRAVITY_MPS2 < length < 1.25 * STANDARD_GRAVITY_MPS2:
        in_g = "; it looks like g: import it with that unit" if 0.8 < length < 1.25 else ""
        raise BadInput(
            f"topic {topic}: gravity reads {length:.3g} m/s2 in the first {parameters.level_s:g} s, "
            f"where it is 9.8{in_g}"
        )
    if z < -0.5 * length:
        raise BadInput(
            f"topic {topic}: the specific force of the first {parameters.level_s:g} s points down "
            f"(z = {z:.3g} m/s2): is the unit mounted upside down? mounting_roll_rad=3.14159 turns it"
        )
    return float(np.arctan2(y, z)), float(np.arctan2(-x, np.hypot(y, z)))


def _first_above(moving: Stream, row: int, limit_mps: float) -> int | None:
    """The first row from this one on with a greater horizontal speed."""
    speed = np.hypot(*moving["velocity_mps"][row:].T[:2])
    faster = np.flatnonzero(speed > limit_mps)
    return row + int(faster[0]) if len(faster) else None


def _bias(samples: _Samples, topic: str, moving: Stream, row: int, parameters: Any) -> Floats:
    """The mean turn rate (3,) at rest; zeros where there was none.

    Raises BadInput where it is more than a gyro errs.
    """
    moved = _first_above(moving, row, parameters.still_mps)
    end_ns = samples.time_ns[-1] if moved is None else moving.publish_time_ns[moved]
    margin_s = parameters.rest_margin_s + parameters.velocity_delay_s
    at_rest = samples.time_ns < end_ns - round(margin_s / _NS)
    bias = samples.rate[at_rest].mean(axis=0) if at_rest.any() else np.zeros(3)
    largest = float(np.abs(bias).max())
    if largest > LARGEST_BIAS_RADPS:
        raise BadInput(
            f"topic {topic}: at rest it turns by {largest:.3g} rad/s, more than the error of any gyro; "
            "it looks "
            "like deg/s: import it with that unit"
        )
    return bias


def _leap(samples: _Samples, moving: Stream, row: int, parameters: Any) -> str:
    """What to say where the unit and the fixes set off as far apart as their clocks' leap seconds."""
    moved = _first_above(moving, row, parameters.still_mps)
    level = samples.time_ns < samples.time_ns[0] + round(parameters.level_s / _NS)
    if moved is None:
        return ""
    change = samples.force - samples.force[level].mean(axis=0)
    noise = 5.0 * change[level].std(axis=0) + SMALLEST_CHANGE_MPS2
    sets_off = np.flatnonzero((np.abs(change) > noise).any(axis=1))
    if not len(sets_off):
        return ""
    moved_ns = moving.publish_time_ns[moved] - round(parameters.velocity_delay_s / _NS)
    later_s = float(moved_ns - samples.time_ns[sets_off[0]]) * _NS
    if abs(abs(later_s) - LEAP_SECONDS) > LEAP_MARGIN_S:
        return ""
    shift_s = np.copysign(LEAP_SECONDS, -later_s) + parameters.inertial_delay_s
    return (
        f"; {moving.topic} starts to move {later_s:.3g} s after the unit: if one clock has the "
        f"{LEAP_SECONDS} leap seconds between GPS time and UTC and the other has not, "
        f"inertial_delay_s={shift_s:g} moves the unit's"
    )


def _heading(
    samples: _Samples,
    start_ns: int,
    moving: Stream,
    row: int,
    tilt: tuple[float, float],
    bias: Floats,
    parameters: Any,
) -> float | None:
    """The heading at the start, rad: the first course, less what the body turned about up until then."""
    fast = _first_above(moving, row, parameters.course_mps)
    if fast is None:
        return None
    end_ns = moving.publish_time_ns[fast] - round(parameters.velocity_delay_s / _NS)
    since = (samples.time_ns >= start_ns) & (samples.time_ns <= end_ns)
    roll, pitch = tilt
    up = np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    turned = np.trapezoid((samples.rate[since] - bias) @ up, (samples.time_ns[since] - start_ns) * _NS)
    east, north, _ = moving["velocity_mps"][fast]
    return float(np.arctan2(north, east) - turned)
