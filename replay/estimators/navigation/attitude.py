"""Orientation of a body that is carried around, from gyro, accelerometer and magnetometer.

The state is the rotation, the gyro's bias, the velocity, and the local magnetic field. The velocity is
integrated from the accelerometer; it stays small because the body is carried around. Over seconds,
motion therefore averages out and gravity remains, as in Laidig and Seel, "VQF", Information Fusion 91,
2023, but here with a known uncertainty. The gate rejects disturbed fields.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.inertial import into_body, into_plane, product, rotation, triad
from fuselog.recorders.models.planar import Components
from fuselog.recorders.models.states import ORIENTATION
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2
from fuselog.replay.engine.arrays import Booleans, Floats, Integers, over_columns
from fuselog.replay.engine.vectors.components import components_of
from fuselog.replay.engine.vectors.tangent import Kind
from fuselog.replay.estimators.navigation.navigation import UNIT as CARRIED
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start, Started

PERIOD_NS = 1_000_000_000
BIAS: Mapping[str, Kind] = {f"gyro_bias_{axis}_radps": "linear" for axis in "xyz"}
VELOCITY: Mapping[str, Kind] = {f"v{axis}_mps": "linear" for axis in "xyz"}
PLACE: Mapping[str, Kind] = {"field_north_ut": "linear", "field_up_ut": "linear"}
FIELD: Mapping[str, Kind] = {f"field_{axis}_ut": "linear" for axis in "xyz"}


class AttitudeParameters(ModelParameters):
    """Noise of the unit and of the body's motion, and the uncertainty at the start.

    The filter assumes that the velocity is near zero and the field nearly constant. It uses these
    assumptions only once a second, because their errors persist for about a second.

    Attributes:
        gyro_noise_density: white noise of the turn rate, in rad/s/sqrt(Hz); it includes scale errors
            while the body moves.
        force_noise_density: white noise of the specific force, in m/s^2/sqrt(Hz); it includes scale
            errors while the body moves.
        gyro_bias_density: random walk of the gyro's bias, in rad/s/sqrt(s).
        field_density_ut: random walk of the magnetic field, in uT/sqrt(s).
        gravity_mps2: acceleration of gravity.
        sigma_velocity_mps: standard deviation of the velocity, whose mean is zero.
        sigma_field_ut: standard deviation of the magnetic field, per axis.
        inertial_gap_s: time without samples above which a gap is assumed, in which the body may rotate.
        gap_turn_radps: standard deviation of the turn rate in a gap.
        rest_s: duration of the stationary period at the start.
        start_sigma_rad: standard deviation of the orientation at the start, per axis.
        gyro_bias_sigma_radps: standard deviation of the gyro's bias at the start, per axis.
        start_sigma_mps: standard deviation of the velocity at the start, per axis.
    """

    gyro_noise_density: NonNegativeFloat = 0.002
    force_noise_density: NonNegativeFloat = 0.05
    gyro_bias_density: NonNegativeFloat = 2e-5
    field_density_ut: NonNegativeFloat = 0.01
    gravity_mps2: PositiveFloat = STANDARD_GRAVITY_MPS2
    sigma_velocity_mps: PositiveFloat = 1.0
    sigma_field_ut: PositiveFloat = 2.0
    inertial_gap_s: PositiveFloat = 0.1
    gap_turn_radps: PositiveFloat = 1.0
    rest_s: PositiveFloat = 1.0
    start_sigma_rad: PositiveFloat = 0.03
    gyro_bias_sigma_radps: PositiveFloat = 0.01
    start_sigma_mps: PositiveFloat = 0.05
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


def move(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the state after a step, given the mean of the samples at the step's two ends."""
    qw, qx, qy, qz, bx, by, bz, vx, vy, vz, north, up = state
    fx, fy, fz, wx, wy, wz = control
    half_s = 0.5 * duration_s
    half = rotation((wx - bx) * half_s, (wy - by) * half_s, (wz - bz) * half_s)
    middle = product((qw, qx, qy, qz), half)
    ax, ay, az = into_plane(middle, (fx, fy, fz))
    qw, qx, qy, qz = product(middle, half)
    vx, vy = vx + duration_s * ax, vy + duration_s * ay
    vz = vz + duration_s * (az - parameters.gravity_mps2)
    return qw, qx, qy, qz, bx, by, bz, vx, vy, vz, north, up


def move_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances that a step adds."""
    turned = parameters.gyro_noise_density**2 * duration_s
    bias = parameters.gyro_bias_density**2 * duration_s
    moved = parameters.force_noise_density**2 * duration_s
    field = parameters.field_density_ut**2 * duration_s
    return turned, turned, turned, bias, bias, bias, moved, moved, moved, field, field


def gap_noise(state: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the variances that a gap of the unit adds."""
    turned, moved = (parameters.gap_turn_radps * duration_s) ** 2, parameters.sigma_velocity_mps**2
    return turned, turned, turned, 0.0, 0.0, 0.0, moved, moved, moved, 0.0, 0.0


def velocity(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the velocity, whose mean is zero."""
    _, _, _, _, _, _, _, vx, vy, vz, _, _ = state
    return vx, vy, vz


def velocity_noise(parameters: Any) -> Components:
    """Return the variances of the velocity of a body that is carried around."""
    variance = parameters.sigma_velocity_mps**2
    return variance, variance, variance


def feel_north(state: Components, reference: Any, parameters: Any) -> Components:
    """Return the magnetic field in the body's axes; the local field has no east component."""
    qw, qx, qy, qz, _, _, _, _, _, _, north, up = state
    return into_body((qw, qx, qy, qz), (0.0, north, up))


def field_noise(parameters: Any) -> Components:
    """Return the variances of an undisturbed field."""
    variance = parameters.sigma_field_ut**2
    return variance, variance, variance


def first_of_periods(stream: Stream) -> Booleans:
    """Test which samples (n,) are the first within a second of the clock, regardless of blocks."""
    rate_hz = stream.metadata.get("rate_hz")
    steps_ns = np.diff(stream.publish_time_ns)
    step_ns = 1e9 / float(rate_hz) if rate_hz else np.median(steps_ns[steps_ns > 0])
    return stream.publish_time_ns % PERIOD_NS < step_ns


def read_velocity(stream: Stream) -> Floats:
    """Return zero velocities (n, 3) once a period, otherwise NaN."""
    return _at(np.zeros((len(stream), 3)), first_of_periods(stream))


def read_field(stream: Stream) -> Floats:
    """Return the first field sample (n, 3) of every period, even if the magnetometer is slower."""
    field = stream["magnetic_field_ut"]
    if field.shape[1:] != (3,):  # the magnetometer has a separate topic
        return np.full((len(stream), 3), np.nan)
    known = np.flatnonzero(over_columns(np.logical_and, np.isfinite(field)))
    if len(known) in (0, len(field)):
        return _at(field, first_of_periods(stream))
    own = stream.take(known)
    metadata = {key: value for key, value in own.metadata.items() if key != "rate_hz"}
    return _at(
        field, known[first_of_periods(replace(own, metadata=metadata))] if len(known) > 1 else known
    )


def read_own_field(stream: Stream) -> Floats:
    """Return the field (n, 3) of a magnetometer with a separate topic, once a period."""
    return _at(stream["magnetic_field_ut"], first_of_periods(stream))


def _at(values: Floats, rows: Booleans | Integers) -> Floats:
    """Return some rows of an array, and NaN in all others."""
    found = np.full(values.shape, np.nan)
    found[rows] = values[rows]
    return found


def find(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find orientation and field from the means at rest: the force points up, the field north.

    Raises BadInput if there is no magnetometer, or if force and field are parallel.
    """
    stream = streams["inertial"]
    begin_ns = int(stream.publish_time_ns[0])
    until_ns = begin_ns + round(parameters.rest_s * 1e9)
    rests = [each.take(each.publish_time_ns <= until_ns) for each in streams.values()]
    rest = stream.take(stream.publish_time_ns <= until_ns)
    fields = (each["magnetic_field_ut"] for each in rests)
    measured = (each for each in fields if each.shape[1:] == (3,) and np.isfinite(each).any())
    force, field = (
        np.nanmean(values, axis=0) if np.isfinite(values).any() else np.full(3, np.nan)
        for values in (rest["specific_force_mps2"], next(measured, np.full((1, 3), np.nan)))
    )
    if not np.isfinite(field).all():
        raise BadInput(
            f"topic {stream.topic}: no magnetic field in the first {parameters.rest_s:g} s, "
            "which determines the heading at the start; increase rest_s, or give the log a prior"
        )
    with np.errstate(invalid="ignore"):
        orientation = triad(force, field)
    if not np.isfinite(orientation).all():
        raise BadInput(
            f"topic {stream.topic}: specific force and magnetic field are parallel at the start, so "
            "they do not determine the heading; give the log a prior"
        )
    _, north, up = into_plane(tuple(orientation), tuple(field))
    mean = np.concatenate([orientation, np.zeros(6), [north, up]])
    sigma = np.repeat(
        [
            parameters.start_sigma_rad,
            parameters.gyro_bias_sigma_radps,
            parameters.start_sigma_mps,
            parameters.sigma_field_ut,
        ],
        [3, 3, 3, 2],
    )
    return Started(
        begin_ns, mean, np.diag(sigma**2), "at rest, levelled, with the heading of the magnetometer"
    )


UNIT = replace(CARRIED, delay="", estimates=True)  # its clock is the only one
ATTITUDE = Model(
    "orientation of a body with a gyro, an accelerometer and a magnetometer",
    {**components_of(ORIENTATION), **BIAS, **VELOCITY, **PLACE},
    AttitudeParameters,
    (
        Sensor(
            UNIT.topic,
            UNIT.schema,
            VELOCITY,
            velocity,
            velocity_noise,
            read=read_velocity,
            linear=True,
        ),
        Sensor(UNIT.topic, UNIT.schema, FIELD, feel_north, field_noise, read=read_field),
        Sensor(
            "magnetic_field",
            schemas.MAGNETIC_FIELD,
            FIELD,
            feel_north,
            field_noise,
            read=read_own_field,
        ),
    ),
    Motion(move, move_noise, gap_noise=gap_noise),
    control=UNIT,
    start=Start({}, find=find),
    by_name=True,
)
