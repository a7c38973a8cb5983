"""Frames of bounded bearings, with the bounds from the metadata of their channels."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.families.sets.regions.feasible_sets import Arena, Pairs, arena_around, make_pairs
from fuselog.replay.families.sets.regions.moving_sets import Growth

CONTRADICTS_ITSELF, CONTRADICTS_PAST, UNDECIDED, FRAME_WRONG, PAST_WRONG = range(5)
FINDINGS = (
    "the bearings of this frame contradict each other: the frame is not used",
    "this frame contradicts the frames before it: the sets of both are kept",
    "this frame contradicts both kept sets: they count as one set from here on",
    "the frame that contradicted those before it was wrong",
    "the frames before the one that contradicted them were wrong",
)
NOT_CUT = (CONTRADICTS_ITSELF, CONTRADICTS_PAST, UNDECIDED)


class Known(NamedTuple):
    """Bound of the bearings, and limits on the robot's position.

    `arena_m` is (low x, low y, high x, high y), or None if the arena is computed from the sensor's
    maximum range. If `maximum_range_m` is None, the longest measured range is used.
    """

    bound_rad: float
    least_landmarks: int
    arena_m: tuple[float, ...] | None
    maximum_range_m: float | None

    def metadata(self) -> dict[str, str]:
        """Return the fields as metadata of a channel."""
        return {name: json.dumps(value) for name, value in self._asdict().items()}

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> "Known":
        """Read the fields from the metadata of a channel."""
        return cls(*(json.loads(metadata[name]) for name in cls._fields))


class Frame(NamedTuple):
    """Relative bearings of one stamp, with the numbers (n, 2) of their landmarks and the arena."""

    time_ns: int
    pairs: Pairs
    numbers: Integers
    arena: Arena


def frames(stream: Stream, landmarks: Stream, known: Known) -> Iterator[Frame]:
    """Yield the frames that have enough landmarks, from a stream of bearings of any type.

    The stream has bearings, ranges and bearings, or relative bearings. Landmarks that are not on the map
    and pairs of the same landmark are left out. Raises BadInput if the distance between the robot and
    the landmarks that it sees is not bounded.
    """
    places_m = read_vectors(landmarks, "position_m", PLANE)
    place_of = dict(zip(landmarks["landmark_id"].tolist(), places_m, strict=True))
    range_m = _maximum_range_m(stream, known) if known.arena_m is None else np.inf
    cuts = np.flatnonzero(np.diff(stream.publish_time_ns)) + 1
    is_relative = "angle_rad" in stream.columns
    for rows in np.split(np.arange(len(stream)), cuts):
        if (1 + is_relative) * len(rows) < known.least_landmarks:
            continue
        if is_relative:
            numbers = np.stack([stream["first_id"][rows], stream["second_id"][rows]], axis=1)
            angle = stream["angle_rad"][rows]
        else:
            first, second = np.triu_indices(len(rows), 1)
            targets, bearing = stream["target_id"][rows], stream["bearing_rad"][rows]
            numbers = np.stack([targets[first], targets[second]], axis=1)
            angle = wrap_angle(bearing[first] - bearing[second])
        mapped = np.isin(numbers, list(place_of)).all(axis=1) & (numbers[:, 0] != numbers[:, 1])
        numbers, angle = numbers[mapped].astype(np.int64), angle[mapped]
        if len(np.unique(numbers)) < known.least_landmarks:
            continue
        places = np.array([place_of[number] for number in numbers.ravel().tolist()])
        pairs = make_pairs(places[0::2], places[1::2], angle, known.bound_rad)
        arena = _arena(known.arena_m) if known.arena_m else _within(places, range_m)
        yield Frame(int(stream.publish_time_ns[rows[0]]), pairs, numbers, arena)


def _maximum_range_m(stream: Stream, known: Known) -> float:
    """Return the sensor's maximum range if it is given, or else the longest range that it measured."""
    if known.maximum_range_m is not None:
        return known.maximum_range_m
    if "range_m" not in stream.columns:
        raise BadInput(
            f"topic {stream.topic}: the robot's position is not bounded: the topic has no ranges and "
            "states no maximum_range_m, and /landmarks states no arena_m; use "
            "--set maximum_range_m=... or --set arena_m=[LOW_X,LOW_Y,HIGH_X,HIGH_Y]"
        )
    return float(stream["range_m"].max(initial=0.0))


def _arena(corners_m: tuple[float, ...]) -> Arena:
    return Arena(np.array(corners_m[:2]), np.array(corners_m[2:]))


def _within(places: Floats, range_m: float) -> Arena:
    """Return the rectangle around the positions that are within a range of every landmark (n, 2).

    If there are no such positions, a landmark was misidentified; the rectangle then contains all
    positions within the range of at least one landmark.
    """
    low, high = places.max(axis=0) - range_m, places.min(axis=0) + range_m
    return Arena(low, high) if np.all(low < high) else arena_around(places, range_m)


class Bounds(NamedTuple):
    """Upper bounds of the errors of odometry and bearings."""

    position: Growth
    heading: Growth
    bearing_rad: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Bounds":
        """Make bounds from values in the order of STATED."""
        return cls(Growth(*values[:2]), Growth(*values[2:4]), values[4])


ERRORS = ("position_error_m", "position_error_mps", "heading_error_rad", "heading_error_radps")
STATED = (*ERRORS, "bearing_bound_rad")


class Bearings(NamedTuple):
    """Bearings (n,) of one stamp, and the positions (n, 2) of their landmarks."""

    place_m: Floats
    bearing_rad: Floats


def frames_with_bearings(
    stream: Stream, landmarks: Stream, known: Known
) -> Iterable[tuple[Frame, Bearings]]:
    """Yield frames and their single bearings; a stream of relative bearings has no single bearings."""
    places = dict(zip(landmarks["landmark_id"].tolist(), landmarks["position_m"][:, :2], strict=True))
    for frame in frames(stream, landmarks, known):
        bearings = Bearings(np.empty((0, 2)), np.empty(0))
        if "bearing_rad" in stream.columns:
            first, end = np.searchsorted(stream.publish_time_ns, [frame.time_ns, frame.time_ns + 1])
            rows = [row for row in range(first, end) if int(stream["target_id"][row]) in places]
            targets = stream["target_id"][rows].tolist()
            bearings = Bearings(
                np.array([places[target] for target in targets]), stream["bearing_rad"][rows]
            )
        yield frame, bearings
