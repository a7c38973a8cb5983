"""Conversion of geodetic fixes to positions in the log's local tangent plane (ENU).

The origin is stated by the log's channels; otherwise it is the first fix of the run.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, schemas
from fuselog.recorders.log.planes import ALTITUDE, LATITUDE, LONGITUDE
from fuselog.recorders.models.geodesy import into_tangent_plane, tangent_axes
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.engine.streams.channels import stated

Floats = NDArray[np.float64]
GEODETIC = schemas.GEODETIC_FIX.full_name


def stated_origin(topics: Mapping[str, Topic]) -> Floats | None:
    """Return the origin (3,) that channels state, or None: latitude and longitude (deg), altitude (m).

    An altitude that is not stated is zero. Raises BadInput if channels state different origins, or if a
    channel states only a latitude or only a longitude.
    """
    found: dict[str, tuple[float, ...]] = {}
    for topic in topics.values():
        if LATITUDE in topic.metadata or LONGITUDE in topic.metadata:
            place = (stated([topic], LATITUDE), stated([topic], LONGITUDE))
            found[topic.name] = (*place, np.nan_to_num(stated([topic], ALTITUDE, needed=False)))
    _refuse_different(found)
    return np.array(next(iter(found.values()))) if found else None


def _refuse_different(found: Mapping[str, tuple[float, ...]]) -> None:
    (first, origin), *others = found.items() or [("", ())]
    for topic, other in others:
        if other != origin:
            raise BadInput(
                f"topics {first} and {topic} state different origins of the plane: {_in_words(origin)} "
                f"and {_in_words(other)} (latitude and longitude in deg, altitude in m); import the log "
                "again with one origin"
            )


def _in_words(origin: Iterable[float]) -> str:
    return ", ".join(f"{number:.9g}" for number in origin)


def origins_of(fixes: Ragged) -> Floats:
    """Return the first fix (runs, 3) of every run in deg, deg and m, or NaN if a run has no fix."""
    has_one = np.diff(fixes.offsets) > 0
    rows = fixes.offsets[:-1][has_one]
    origins = np.full((fixes.runs, 3), np.nan)
    origins[has_one, 0] = fixes["latitude_deg"][rows]
    origins[has_one, 1] = fixes["longitude_deg"][rows]
    origins[has_one, 2] = np.nan_to_num(fixes["altitude_m"][rows])
    return origins


def in_plane(fixes: Ragged, origins: Floats) -> Ragged:
    """Convert geodetic fixes to positions (n, 3) relative to origins (runs, 3).

    A missing value, such as the altitude, becomes NaN. Covariances (n, 9) are rotated from the axes of
    the fix to the axes of the origin. A log may store a covariance as a diagonal or in full, for east
    and north only or with up.

    Args:
        fixes: latitudes, longitudes and altitudes of all runs.
        origins: (runs, 3) latitudes and longitudes in deg, altitudes in m, see `origins_of`.
    """
    stream = fixes.stream
    origin = origins[run_of_rows(fixes.offsets)]
    place = stream["latitude_deg"], stream["longitude_deg"]
    is_flat = np.isnan(stream["altitude_m"])
    altitude = np.where(is_flat, origin[:, 2], stream["altitude_m"])
    position = np.stack(into_tangent_plane((*place, altitude), tuple(origin.T)), axis=1)
    position[is_flat, 2] = np.nan
    columns = {
        "sensor_time_ns": stream["sensor_time_ns"],
        "position_m": position,
        "covariance_m2": _turned(stream, tangent_axes(*origin.T[:2]), tangent_axes(*place)),
    }
    return Ragged(replace(stream, schema=schemas.POSITION_FIX, columns=columns), fixes.offsets)


def _turned(stream: Stream, axes: Floats, own: Floats) -> Floats:
    """Rotate the fixes' covariances (n, 9) from their own axes to `axes` (n, 3, 3); keep NaN."""
    covariance = covariances_of_fixes(stream)
    turn, unknown = axes @ own.transpose(0, 2, 1), np.isnan(covariance)
    turned = turn @ np.where(unknown, 0.0, covariance) @ turn.transpose(0, 2, 1)
    return np.where(unknown, np.nan, turned).reshape(-1, 9)


def covariances_of_fixes(stream: Stream) -> Floats:
    """Read the covariances (n, 3, 3) of fixes along east, north and up, in m^2; missing ones are NaN.

    Raises BadInput if their width is invalid.
    """
    given = stream.columns.get("covariance_m2", np.empty((len(stream), 0)))
    size = {0: 0, 2: 2, 3: 3, 4: 2, 9: 3}.get(given.shape[1])
    if size is None:
        raise BadInput(
            f"topic {stream.topic}: covariance_m2 has {given.shape[1]} numbers; 2 or 4 are needed for "
            "east and north, 3 or 9 with up"
        )
    covariance = np.full((len(stream), 3, 3), np.nan)
    if size:
        is_full = given.shape[1] == size**2
        own_axes = given.reshape(-1, size, size) if is_full else given[:, :, None] * np.eye(size)
        covariance[:, :size, :size] = own_axes
    return covariance
