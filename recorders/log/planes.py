"""The planes and frames of positions, as channels state them.

A plane is the local tangent plane (east, north, up) at an origin. A channel without an origin is in the
plane of its log, unless it names its own frame.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.schemas import (
    COURSE_FIX,
    GAUSSIAN_ESTIMATE,
    GEODETIC_FIX,
    POSE,
    POSITION_FIX,
    TRUTH_STATE,
    VELOCITY_FIX,
)
from fuselog.recorders.log.streams import Stream

LATITUDE, LONGITUDE, ALTITUDE = ORIGIN = (
    "origin_latitude_deg",
    "origin_longitude_deg",
    "origin_altitude_m",
)
FRAME, BODY = "frame_id", "child_frame_id"
# The name of the log's frame in files of other tools, which need one; as in REP 105.
WORLD = "map"
EXAMPLE = "latitude and longitude in deg, and altitude in m, such as 49.01,8.4,115"
_STATES = (TRUTH_STATE.full_name, GAUSSIAN_ESTIMATE.full_name)
_PLANAR = {each.full_name for each in (POSITION_FIX, VELOCITY_FIX, POSE, COURSE_FIX, GEODETIC_FIX)}


class Origin(NamedTuple):
    """The origin of a local tangent plane: latitude, longitude (deg), height above the ellipsoid (m)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata for channels of streams in the plane."""
        return dict(zip(ORIGIN, map(repr, self), strict=True))

    def __str__(self) -> str:
        return f"{self.latitude_deg:.9g}, {self.longitude_deg:.9g}, {self.altitude_m:.6g}"


def origin_of(parts: Sequence[str]) -> Origin | None:
    """Parse an origin from two or three numbers; return None if they are invalid."""
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return None
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        return None
    found = Origin(*numbers)
    return found if abs(found.latitude_deg) <= 90.0 and abs(found.longitude_deg) <= 360.0 else None


def stated_in(topic: str, metadata: Mapping[str, str]) -> Origin | None:
    """Return the origin that a topic's channel states, or None; a missing height is taken as zero.

    Raises BadInput if it is not a position on the earth.
    """
    if LATITUDE not in metadata or LONGITUDE not in metadata:
        return None
    parts = [metadata[name] for name in ORIGIN if name in metadata]
    found = origin_of(parts)
    if found is None:
        raise BadInput(
            f"topic {topic} states the origin {', '.join(parts)}; expected {EXAMPLE}; record it again"
        )
    return found


def is_planar(schema_name: str, metadata: Mapping[str, str]) -> bool:
    """Test whether messages have positions or velocities in a plane, or on the earth."""
    if schema_name in _STATES:
        return {"x_m", "y_m"} <= set(metadata.get("components", "").split(","))
    return schema_name in _PLANAR


def frame_of(metadata: Mapping[str, str]) -> str:
    """Return the frame that a channel names; an empty text means the plane of the log."""
    return "" if LATITUDE in metadata else metadata.get(FRAME, "")


def world_of(metadata: Mapping[str, str]) -> str:
    """Return the frame that a channel names, or `WORLD`."""
    return metadata.get(FRAME) or WORLD


def in_frame(frame: str) -> dict[str, str]:
    """Return the metadata for the channel of positions in a frame; empty for the plane of the log."""
    return {FRAME: frame} if frame else {}


def body_of(topic: str, metadata: Mapping[str, str]) -> str:
    """Return the frame whose pose a topic's states describe: as stated, or the topic's namespace.

    >>> body_of("/radar/truth", {})
    'radar'
    """
    name = topic.strip("/")
    return metadata.get(BODY) or name.rpartition("/")[0] or name


def frame_in_words(frame: str) -> str:
    """Describe a frame as returned by `frame_of`."""
    return f"frame {frame}" if frame else "the plane of the log"


def plane_in_words(metadata: Mapping[str, str]) -> str:
    """Describe the frame that a channel names, or an unnamed one."""
    return f"frame {metadata[FRAME]}" if metadata.get(FRAME) else "a frame of its own"


def common_origin(channels: Mapping[str, Mapping[str, str]]) -> Origin | None:
    """Return the origin of a log's plane, if all topics that state an origin agree."""
    stated = {origin for topic, each in channels.items() if (origin := stated_in(topic, each))}
    return stated.pop() if len(stated) == 1 else None


def in_plane_of_log(streams: Sequence[Stream]) -> list[Stream]:
    """Add the plane of the log to the metadata of streams without a frame, if some streams state it."""
    origin = common_origin({stream.topic: stream.metadata for stream in streams})
    return [in_plane(stream, origin) for stream in streams]


def in_plane(stream: Stream, origin: Origin | None) -> Stream:
    """Add the log's plane to the metadata of a stream that states neither plane nor frame."""
    own = stream.metadata
    if origin is None or LATITUDE in own or own.get(FRAME):
        return stream
    if not is_planar(stream.schema.full_name, own):
        return stream
    return replace(stream, metadata={**own, **origin.metadata})
