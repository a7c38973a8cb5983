"""The motion of a body according to its topics: positions, velocities, wheels, turns.

All quantities are arrays over time, in seconds since the log's first stamp. Values that are valid until
the next one, and samples, are both integrated over time, so topics without common stamps can be compared
by the distances and turns in a window.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.geodesy import local_metres

Floats = NDArray[np.float64]
FEWEST = 20  # messages; topics with fewer are not checked


@dataclass(frozen=True)
class Series:
    """One quantity of a topic over time.

    Attributes:
        topic, field: where the quantity comes from.
        times_s: stamps (n,), which increase.
        values: (n,) or (n, m).
        holds: whether a value is valid until the next one; otherwise it is a sample.
    """

    topic: str
    field: str
    times_s: Floats
    values: Floats
    holds: bool = False

    def integral(self, times_s: Floats) -> Floats:
        """Integrate the values from the first stamp to given times (...); NaN after the last stamp."""
        found = [
            np.interp(times_s, self.times_s, column, left=np.nan, right=np.nan) for column in self.totals
        ]
        return np.stack(found, axis=-1).reshape(*np.shape(times_s), *self.values.shape[1:])

    @cached_property
    def totals(self) -> Floats:
        """The integral of each component to each stamp: (m, n)."""
        flat = self.values.reshape(len(self.values), -1)
        means = flat[:-1] if self.holds else 0.5 * (flat[:-1] + flat[1:])
        totals = np.zeros_like(flat)
        np.cumsum(means * np.diff(self.times_s)[:, None], axis=0, out=totals[1:])
        return np.ascontiguousarray(totals.T)

    def moved(self, by_s: float, gain: float = 0.0) -> "Series":
        """Return the series with stamps corrected for a delay, and for the gain of its clock."""
        first_s = self.times_s[0]
        times_s = self.times_s - gain * (self.times_s - first_s) - by_s
        return Series(self.topic, self.field, times_s, self.values, self.holds)


@dataclass(frozen=True)
class PlaceSeries(Series):
    """Positions (n, 2) east and north, or along x and y, with their stated variances (n,).

    If `is_flat`, the positions were logged in metres and may have a scale error; otherwise as latitudes
    and longitudes.
    """

    variances_m2: Floats = field(default_factory=lambda: np.empty(0))
    is_flat: bool = True


@dataclass
class Body:
    """The topics of one body.

    Attributes:
        fixes: positions.
        velocities: velocities in the frame of the positions (n, 2).
        speeds: forward speeds, as from wheels.
        turns: turn rates about the vertical.
        rates: turn rates (n, 3) about the body's axes.
        forces: specific forces (n, 3).
        orientations: measured unit quaternions (n, 4).
        references: unit quaternions (n, 4) of the truth.
    """

    fixes: list[PlaceSeries] = field(default_factory=list)
    velocities: list[Series] = field(default_factory=list)
    speeds: list[Series] = field(default_factory=list)
    turns: list[Series] = field(default_factory=list)
    rates: list[Series] = field(default_factory=list)
    forces: list[Series] = field(default_factory=list)
    orientations: list[Series] = field(default_factory=list)
    references: list[Series] = field(default_factory=list)

    @property
    def roles(self) -> list[Sequence[Series]]:
        """Return the topics of each kind, one list per attribute."""
        measured = self.rates, self.forces, self.orientations, self.references
        return [self.fixes, self.velocities, self.speeds, self.turns, *measured]


def bodies(streams: Mapping[str, Stream]) -> list[Body]:
    """Group topics by body: one body per namespace, or only one if no kind of topic occurs twice.

    A nested namespace includes the topics of the outer one, so the body of `/imu2/inertial` has the
    positions of `/fix` too.
    """
    first_ns = min(
        (int(each.publish_time_ns.min()) for each in streams.values() if len(each)), default=0
    )
    parts = {topic: _part(each, first_ns) for topic, each in streams.items() if len(each) >= FEWEST}
    together = _joined(parts.values())
    if all(len({each.topic for each in role}) <= 1 for role in together.roles):
        return [together]
    spaces = {topic: f"{topic.rpartition('/')[0]}/" for topic in parts}
    return [
        _joined(part for topic, part in parts.items() if name.startswith(spaces[topic]))
        for name in dict.fromkeys(spaces.values())
    ]


def _joined(parts: Iterable[Body]) -> Body:
    """Join the topics of several bodies."""
    several = list(parts)
    return Body(
        **{
            each.name: [series for part in several for series in getattr(part, each.name)]
            for each in fields(Body)
        }
    )


def _part(stream: Stream, first_ns: int) -> Body:
    """Return a body that has only one topic."""
    body = Body()
    name, topic = stream.schema.full_name, stream.topic
    order = np.argsort(stream.publish_time_ns, kind="stable")
    stamps_ns = stream.publish_time_ns[order]
    is_new = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0
    rows = order[is_new]
    times_s = 1e-9 * (stream.publish_time_ns[rows] - first_ns).astype(float)

    def series(field_: str, values: Floats, *, holds: bool = False) -> Series:
        known = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        return Series(topic, field_, times_s[known], values[known], holds)

    def column(field_: str) -> Floats:
        return stream[field_][rows]

    if name in _PLACED and column("position_m").shape[1] >= 2:
        body.fixes.append(_fixes(series("position_m", column("position_m")[:, :2]), stream, rows))
    if name == schemas.GEODETIC_FIX.full_name:
        body.fixes.append(_geodetic(stream, rows, times_s))
    if name == schemas.VELOCITY_FIX.full_name:
        body.velocities.append(series("velocity_mps", column("velocity_mps")[:, :2]))
    if name == schemas.COURSE_FIX.full_name:
        speed, course = column("speed_mps"), column("course_rad")
        velocity = speed[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1)
        body.velocities.append(series("speed_mps", velocity))
    if name == schemas.ODOMETRY.full_name:
        body.speeds.append(series("forward_mps", column("forward_mps"), holds=True))
        body.turns.append(series("turn_radps", column("turn_radps"), holds=True))
    if name == schemas.TWIST.full_name and column("velocity_mps").shape[1] == 3:
        body.speeds.append(series("velocity_mps", column("velocity_mps")[:, 0]))
        body.rates.append(series("turn_rate_radps", column("turn_rate_radps")))
    if name == schemas.INERTIAL_SAMPLE.full_name:
        body.rates.append(series("turn_rate_radps", column("turn_rate_radps")))
        body.forces.append(series("specific_force_mps2", column("specific_force_mps2")))
    if body.rates:
        body.turns.append(series("turn_rate_radps", column("turn_rate_radps")[:, 2]))
    if name in _TURNED and column("quaternion").shape[1] == 4:
        body.orientations.append(series("quaternion", column("quaternion")))
    if name == schemas.TRUTH_STATE.full_name:
        kinds = stream.metadata.get("kinds", "").split(",")
        if kinds.count("quaternion") == 4:
            begin = kinds.index("quaternion")
            body.references.append(series("state", column("state")[:, begin : begin + 4]))
    for role in body.roles:
        if role and len(role[-1].times_s) < FEWEST:
            role.pop()  # type: ignore[attr-defined]
    return body


_PLACED = {each.full_name for each in (schemas.POSITION_FIX, schemas.POSE, schemas.COURSE_FIX)}
_TURNED = {each.full_name for each in (schemas.ORIENTATION, schemas.POSE)}


def _fixes(
    places: Series, stream: Stream, rows: NDArray[np.int64], *, is_flat: bool = True
) -> PlaceSeries:
    """Return positions with the mean of their two stated horizontal variances, NaN if not stated."""
    column = stream.columns.get("covariance_m2")
    variances = np.full(len(places.times_s), np.nan)
    if column is not None and len(places.times_s) == len(rows) and column.shape[1]:
        width = column.shape[1]
        size = round(width**0.5)
        second = size + 1 if size * size == width and width > 1 else 1
        variances = 0.5 * (column[rows, 0] + column[rows, min(second, width - 1)])
    return PlaceSeries(
        places.topic,
        places.field,
        places.times_s,
        places.values,
        variances_m2=variances,
        is_flat=is_flat,
    )


def _geodetic(stream: Stream, rows: NDArray[np.int64], times_s: Floats) -> PlaceSeries:
    """Return geodetic positions relative to their median."""
    values = local_metres(stream["latitude_deg"][rows], stream["longitude_deg"][rows])
    known = np.isfinite(values).all(axis=1)
    places = Series(stream.topic, "latitude_deg", times_s[known], values[known])
    return _fixes(places, stream, rows[known], is_flat=False)
