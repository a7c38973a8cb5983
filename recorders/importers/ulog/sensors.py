"""Conversion of the topics of sensors, with one function for each topic.

Vectors are rotated from NED to ENU, or in the body from FRD to FLU (forward, left, up).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.importers.ulog.file import Rows
from fuselog.recorders.log import Schema, schemas
from fuselog.recorders.models.orientation import compose

Floats = NDArray[np.float64]
BODY = "/vehicle"
_GAUSS_UT = 100.0
_FIELD = ("field_x_ut", "field_y_ut", "field_z_ut")
# An unknown time relative to the stamp, in microseconds, as in PX4.
_INVALID_US = 2**31 - 1
# The largest difference between heights above the ellipsoid and above the sea.
FARTHEST_M = 150.0

# The rotation from north, east, down to east, north, up: half a turn about north-east.
_TO_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
# The rotation from forward, left, up to forward, right, down: half a turn about the forward axis.
_FROM_FLU = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Part:
    """Messages (n,) of a stream, with times of measurement and logging in us, and their columns.

    The maker of the stream leaves out rows in which a required number is not finite; `facts` counts rows
    that are left out or changed for other reasons.
    """

    topic: str
    schema: Schema
    time_us: NDArray[np.int64]
    logged_us: NDArray[np.int64]
    columns: Mapping[str, NDArray]
    metadata: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, int] = field(default_factory=dict)

    def take(self, which: NDArray) -> "Part":
        """Select the messages of some rows."""
        columns = {name: column[which] for name, column in self.columns.items()}
        return replace(
            self, time_us=self.time_us[which], logged_us=self.logged_us[which], columns=columns
        )


class Fields(NamedTuple):
    """The fields of a topic's rows, as numbers.

    `is_first` states whether the rows belong to the first instance of the topic. `separation_m` is the
    height of the sea level above the ellipsoid where the log was recorded; 0 if unknown.
    """

    rows: Rows
    is_first: bool = True
    separation_m: float = 0.0

    def named(self, name: str) -> str:
        """Name a stream that most logs have once; names of further instances contain their numbers."""
        return name if self.is_first else f"{name}_{self.rows.topic}_{self.rows.instance}"

    def has(self, name: str) -> bool:
        """Test whether there is a field of this name."""
        return name in (self.rows.data.dtype.names or ())

    def of(self, name: str) -> Floats:
        """Return a field (n,); NaN if it is missing."""
        if not self.has(name):
            return np.full(len(self.rows.data), np.nan)
        return self.rows.data[name].astype(float)

    def vector(self, *names: str, width: int = 0) -> Floats:
        """Return several fields, or the `width` elements of an array, as (n, width)."""
        every = [f"{names[0]}[{index}]" for index in range(width)] if width else names
        return np.stack([self.of(name) for name in every], axis=1)

    @property
    def measured_us(self) -> NDArray[np.int64]:
        """Return when rows were measured: by the sample's stamp, or by the row's if there is none."""
        if not self.has("timestamp_sample"):
            return self.rows.time_us
        sample = self.rows.data["timestamp_sample"].astype(np.int64)
        near = np.abs(sample - self.rows.time_us) < 10_000_000
        return np.where(near & (sample > 0), sample, self.rows.time_us)

    def part(
        self, topic: str, schema: Schema, metadata: Mapping[str, str] | None = None, **columns: Floats
    ) -> Part:
        """Make messages of a stream from all rows."""
        return Part(
            f"{BODY}/{topic}", schema, self.measured_us, self.rows.time_us, columns, metadata or {}
        )

    def values(self, topic: str, components: Mapping[str, str]) -> Part:
        """Make plain numbers from fields, under names with their units."""
        there = {name: of for name, of in components.items() if self.has(of)}
        metadata = {"components": ",".join(there), "kinds": ",".join(["linear"] * len(there))}
        value = self.vector(*there.values())
        return self.part(topic, schemas.VECTOR_MEASUREMENT, metadata, value=value)


def combined(fields: Fields) -> Iterator[Part]:
    """Yield the filter's inertial samples; with old firmware also its magnetometer and barometer."""
    force = to_flu(fields.vector("accelerometer_m_s2", width=3))
    rate = to_flu(fields.vector("gyro_rad", width=3))
    yield _inertial(fields, fields.named("inertial"), force, rate)
    if fields.has("magnetometer_ga[0]"):
        field_ut = _GAUSS_UT * to_flu(fields.vector("magnetometer_ga", width=3))
        part = _magnetic(fields, fields.named("magnetometer"), field_ut)
        yield _at_own_time(fields, "magnetometer", part)
    if fields.has("baro_alt_meter"):
        part = fields.values(fields.named("barometer"), {"altitude_m": "baro_alt_meter"})
        yield _at_own_time(fields, "baro", part)


def _inertial(fields: Fields, topic: str, force: Floats, rate: Floats) -> Part:
    none = np.full((len(force), 3), np.nan)
    return fields.part(
        topic,
        schemas.INERTIAL_SAMPLE,
        specific_force_mps2=force,
        turn_rate_radps=rate,
        magnetic_field_ut=none,
    )


def _magnetic(fields: Fields, topic: str, field_ut: Floats) -> Part:
    unknown = np.full((len(field_ut), 9), np.nan)
    metadata = {"components": ",".join(_FIELD), "kinds": ",".join(["linear"] * len(_FIELD))}
    columns = {"magnetic_field_ut": field_ut, "covariance_ut2": unknown}
    return fields.part(topic, schemas.MAGNETIC_FIELD, metadata, **columns)


def _at_own_time(fields: Fields, sensor: str, part: Part) -> Part:
    """Apply a sensor's time, which is relative to the row's; drop repetitions of its messages."""
    relative_us = fields.rows.data[f"{sensor}_timestamp_relative"].astype(np.int64)
    is_valid = relative_us != _INVALID_US
    time_us = part.time_us + np.where(is_valid, relative_us, 0)
    is_new = is_valid & (np.diff(time_us, prepend=-1) != 0)
    facts = {"left out without a time": int((~is_valid).sum())}
    return replace(part, time_us=time_us, facts=facts).take(is_new)


def unit(fields: Fields) -> Iterator[Part]:
    """Yield the samples of one of several inertial units, from its increments and their time spans."""
    spans = {}
    for of in ("angle", "velocity"):
        span = fields.of(f"delta_{of}_dt")
        is_us = fields.rows.data.dtype[f"delta_{of}_dt"].kind == "u"
        spans[of] = (span * 1e-6 if is_us else span)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        force = to_flu(fields.vector("delta_velocity", width=3)) / spans["velocity"]
        rate = to_flu(fields.vector("delta_angle", width=3)) / spans["angle"]
    yield _inertial(fields, f"imu_{fields.rows.instance}", force, rate)


def accelerometer(fields: Fields) -> Iterator[Part]:
    """Yield the readings of one accelerometer without conversion, in its own axes."""
    names = {f"force_{axis}_mps2": axis for axis in "xyz"}
    yield fields.values(f"accelerometer_{fields.rows.instance}", names)


def gyro(fields: Fields) -> Iterator[Part]:
    """Yield the readings of one gyroscope without conversion, in its own axes."""
    yield fields.values(f"gyro_{fields.rows.instance}", {f"rate_{axis}_radps": axis for axis in "xyz"})


def magnetometer(fields: Fields) -> Iterator[Part]:
    """Yield the field from the filter's magnetometer, under a name that no model reads by default.

    `--set topics.magnetic_field=/vehicle/magnetometer` selects it; the model then needs the local field.
    """
    field_ut = _GAUSS_UT * to_flu(fields.vector("magnetometer_ga", width=3))
    yield _magnetic(fields, fields.named("magnetometer"), field_ut)


def raw_magnetometer(fields: Fields) -> Iterator[Part]:
    """Yield the readings of one magnetometer."""
    field_ut = _GAUSS_UT * to_flu(fields.vector("x", "y", "z"))
    yield _magnetic(fields, f"magnetometer_{fields.rows.instance}", field_ut)


class Heights(NamedTuple):
    """Heights (n,) of fixes above the ellipsoid and above the sea, and whether these agree.

    Simulators and old drivers leave the height above the ellipsoid empty, or write garbage.
    """

    ellipsoid_m: Floats
    sea_m: Floats
    agree: NDArray[np.bool_]


def heights(fields: Fields) -> Heights:
    """Read the heights of a receiver's fixes."""
    if fields.has("altitude_ellipsoid_m"):
        ellipsoid_m, sea_m = fields.of("altitude_ellipsoid_m"), fields.of("altitude_msl_m")
    else:
        ellipsoid_m, sea_m = 1e-3 * fields.of("alt_ellipsoid"), 1e-3 * fields.of("alt")
    is_near = np.abs(ellipsoid_m - sea_m) <= FARTHEST_M
    return Heights(ellipsoid_m, sea_m, is_near & (ellipsoid_m != 0.0))


def gnss(fields: Fields) -> Iterator[Part]:
    """Yield a receiver's position and velocity; eph, epv and s_variance_m_s are standard deviations."""
    if fields.has("latitude_deg"):
        place = fields.vector("latitude_deg", "longitude_deg")
    else:
        place = fields.vector("lat", "lon") * 1e-7
    ellipsoid_m, sea_m, agree = heights(fields)
    is_wrong = ~agree & np.isfinite(sea_m)
    height_m = np.where(is_wrong, sea_m + fields.separation_m, ellipsoid_m)
    own = fields.rows.topic == "vehicle_gps_position"
    name = fields.named("{}") if own else f"{{}}_{fields.rows.instance}"
    has_fix = fields.of("fix_type") >= 3
    horizontal, vertical, speed = (fields.of(each) ** 2 for each in ("eph", "epv", "s_variance_m_s"))
    higher = f", {fields.separation_m:.4g} m higher" if fields.separation_m else ""
    facts = {
        "left out without a fix": int((~has_fix).sum()),
        f"its height above the ellipsoid is 0, missing or more than {FARTHEST_M:g} m from that above "
        f"the sea, which is used instead{higher}": int((is_wrong & has_fix).sum()),
    }
    fix = fields.part(
        name.format("fix"),
        schemas.GEODETIC_FIX,
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        altitude_m=height_m,
        covariance_m2=np.stack([horizontal, horizontal, vertical], axis=1),
    )
    yield replace(fix, facts=facts).take(has_fix)
    is_valid = has_fix & (fields.of("vel_ned_valid") != 0)
    velocity = to_enu(fields.vector("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"))
    covariance = speed[:, None] * np.eye(3).ravel()
    yield fields.part(
        name.format("velocity"), schemas.VELOCITY_FIX, velocity_mps=velocity, covariance_m2ps2=covariance
    ).take(is_valid)


def air(fields: Fields) -> Iterator[Part]:
    """Yield the height in the standard atmosphere, from the barometer that the filter uses."""
    yield fields.values(
        fields.named("barometer"),
        {"altitude_m": "baro_alt_meter", "pressure_pa": "baro_pressure_pa",
         "temperature_degc": "baro_temp_celcius"},
    )  # fmt: skip


def barometer(fields: Fields) -> Iterator[Part]:
    """Yield the readings of one barometer; the pressure is in Pa, or in hPa with old firmware."""
    names = {"pressure": "pressure", "temperature_degc": "temperature"}
    yield fields.values(f"barometer_{fields.rows.instance}", names)


def airspeed(fields: Fields) -> Iterator[Part]:
    """Yield the airspeed."""
    names = {"indicated_mps": "indicated_airspeed_m_s", "true_mps": "true_airspeed_m_s"}
    yield fields.values(f"airspeed_{fields.rows.instance}", names)


def flow(fields: Fields) -> Iterator[Part]:
    """Yield the angles about the body's x and y by which a camera saw the ground move in a time span."""
    old = fields.has("pixel_flow_x_integral")
    x, y = (
        ("pixel_flow_x_integral", "pixel_flow_y_integral") if old else ("pixel_flow[0]", "pixel_flow[1]")
    )
    span = "integration_timespan" if old else "integration_timespan_us"
    names = {"flow_x_rad": x, "flow_y_rad": y, "span_us": span, "quality": "quality"}
    yield fields.values(f"flow_{fields.rows.instance}", names)


def distance(fields: Fields) -> Iterator[Part]:
    """Yield the range of a distance sensor."""
    names = {"distance_m": "current_distance", "variance_m2": "variance"}
    yield fields.values(f"distance_{fields.rows.instance}", names)


SENSORS: dict[str, Callable[[Fields], Iterator[Part]]] = {
    "sensor_combined": combined,
    "vehicle_imu": unit,
    "sensor_accel": accelerometer,
    "sensor_gyro": gyro,
    "vehicle_magnetometer": magnetometer,
    "sensor_mag": raw_magnetometer,
    "vehicle_gps_position": gnss,
    "sensor_gps": gnss,
    "vehicle_air_data": air,
    "sensor_baro": barometer,
    "airspeed": airspeed,
    "sensor_optical_flow": flow,
    "optical_flow": flow,
    "distance_sensor": distance,
}


def to_enu(vectors: Floats) -> Floats:
    """Convert vectors (n, 3) from north, east, down to east, north, up."""
    return vectors[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def to_flu(vectors: Floats) -> Floats:
    """Convert vectors (n, 3) from forward, right, down to forward, left, up."""
    return vectors * [1.0, -1.0, -1.0]


def orientations(quaternions: Floats) -> Floats:
    """Convert a body's rotations (n, 4; w, x, y, z) from FRD-to-NED to FLU-to-ENU."""
    return compose(compose(np.broadcast_to(_TO_ENU, quaternions.shape), quaternions), _FROM_FLU)
