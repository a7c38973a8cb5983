"""Guaranteed position sets from bounded relative bearings, one set for each stamp of bearings.

Briechle, Hanebeck (2004). The estimate is a set: the exact one, its tightest box, or a
pseudo-ellipsoid with L = 4 or L = 8. An empty set is a fault: the relative bearing that is probably
wrong is then also written to the topic of faults.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.families.sets.regions.feasible_sets import (
    Arena,
    Pairs,
    box,
    exact_set,
    rings,
    to_blame,
)
from fuselog.replay.families.sets.regions.frames import Frame, Known, frames
from fuselog.replay.families.sets.regions.pseudo_ellipsoids import Weighting, fit, outline

LEAVES = ("relative_bearing", "range_bearing", "bearing")


class SetParameters(Parameters):
    """Form of the sets, and bounds of the errors; missing bounds are read from the log.

    All pairs of bearings with equal stamps are used.

    Attributes:
        shape: form of the sets: exact, the box around them, or the paper's pseudo-ellipsoids L = 4 and L
            = 8.
        bound_deg: bound of the error of a relative bearing.
        weighting: weights of the rings that pseudo-ellipsoids fuse: minimal area after each step (area)
            or after all steps (batch), minimal determinant (determinant), or equal weights (equal).
        sweeps: number of times that pseudo-ellipsoids fuse all pairs.
        least_landmarks: smallest number of landmarks at one stamp for which a set is computed.
        arena_m: rectangle that certainly contains the robot (low x, low y, high x, high y).
        maximum_range_m: if no arena is given, the greatest distance of a robot from a landmark that it
            sees; by default, the longest range that its sensor measured.
    """

    shape: Literal["exact", "box", "l4", "l8"] = "exact"
    bound_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    weighting: Weighting = "area"
    sweeps: PositiveInt = 1
    least_landmarks: Annotated[int, Field(ge=2)] = 3
    arena_m: tuple[float, float, float, float] | None = None
    maximum_range_m: PositiveFloat | None = None


def polygons(pairs: Pairs, arena: Arena, parameters: SetParameters) -> list[Floats]:
    """Compute the border of the chosen set of one frame, as a list of polygons; it may be empty."""
    if parameters.shape in ("l4", "l8"):
        order: Literal[4, 8] = 4 if parameters.shape == "l4" else 8
        try:
            fused = fit(pairs, arena, order, parameters.weighting, parameters.sweeps)
        except BadInput:  # no common point: an empty set
            return []
        return outline(fused, arena).rings
    border = exact_set(pairs, arena)
    if len(border.length) == 0 or parameters.shape == "exact":
        return rings(border)
    (low_x, low_y), (high_x, high_y) = box(border)
    return [np.array([[low_x, low_y], [high_x, low_y], [high_x, high_y], [low_x, high_y]])]


def solve(given: Given[SetParameters]) -> list[Ragged]:
    """Compute a set for every frame of every run; see `fuselog.replay.engine.api.functions.batch`."""
    known: Known = given.setup
    prefix, metadata = f"/estimates/{given.name}", set_metadata(given.topics["seen"].name, known)
    solved = []
    for run in range(given.runs):
        found = frames(given["seen"].of_run(run), given["/landmarks"].of_run(run), known)
        borders = [(frame, polygons(frame.pairs, frame.arena, given.parameters)) for frame in found]
        blamed = [
            (frame, int(pair))
            for frame, border in borders
            if not border
            for pair in to_blame(frame.pairs, frame.arena)[:1]
        ]
        rings_of = [(frame.time_ns, border) for frame, border in borders]
        solved.append((*set_streams(prefix, metadata, rings_of), fault_stream(prefix, blamed)))
    return [gather(streams) for streams in zip(*solved, strict=True)]


def set_metadata(topic: str, known: Known) -> dict[str, str]:
    """Make the metadata of a channel of sets: components, truth, and settings of their frames."""
    return {
        "components": "x_m,y_m",
        "kinds": "linear,linear",
        "truth": f"{topic.rpartition('/')[0]}/truth",
        "measured": topic,
        **known.metadata(),
    }


def set_streams(
    prefix: str, metadata: Mapping[str, str], borders: Sequence[tuple[int, list[Floats]]]
) -> tuple[Stream, Stream]:
    """Make two streams for the sets of a run: numbers of vertices, and vertices.

    Args:
        prefix: prefix of their topics.
        metadata: metadata of the channels.
        borders: stamp (ns) and rings of each set, (vertices, 2) in m; no rings for an empty set.
    """

    def whole(numbers: Iterable[int]) -> Integers:
        return np.fromiter(numbers, np.int64)

    rings_of = [(time_ns, *each) for time_ns, found in borders for each in enumerate(found)]
    lengths = whole(len(ring) for *_, ring in rings_of)
    return (
        make_stream(
            f"{prefix}/set",
            schemas.SET_ESTIMATE,
            np.repeat(whole(time_ns for time_ns, *_ in rings_of), lengths),
            metadata=metadata,
            ring_id=np.repeat(whole(number for _, number, _ in rings_of), lengths),
            vertex=np.concatenate([np.empty((0, 2)), *(ring for *_, ring in rings_of)]),
        ),
        make_stream(
            f"{prefix}/size",
            schemas.ESTIMATE_SIZE,
            whole(time_ns for time_ns, _ in borders),
            metadata=metadata,
            elements=whole(sum(map(len, found)) for _, found in borders),
        ),
    )


def fault_stream(prefix: str, blamed: Sequence[tuple[Frame, int]]) -> Stream:
    """Make a stream of the relative bearings that caused empty sets, each given by frame and pair."""
    pairs = np.array([frame.numbers[pair] for frame, pair in blamed], np.int64).reshape(-1, 2)
    return make_stream(
        f"{prefix}/fault",
        schemas.RELATIVE_BEARING,
        np.array([frame.time_ns for frame, _ in blamed], np.int64),
        metadata={"purpose": "the set is empty; this relative bearing is to blame"},
        first_id=pairs[:, 0],
        second_id=pairs[:, 1],
        angle_rad=np.array([frame.pairs.angle_rad[pair] for frame, pair in blamed]),
    )


def bearings_in(topics: Mapping[str, Topic], leaves: Sequence[str]) -> Iterator[tuple[str, Topic]]:
    """Find the robots with bearings in a log with landmarks; yield each prefix and topic of bearings.

    Args:
        topics: topics of the log.
        leaves: the last parts of the topics' names, the preferred ones first.
    """
    for prefix in dict.fromkeys(topic.rpartition("/")[0] for topic in topics):
        leaf = next((leaf for leaf in leaves if f"{prefix}/{leaf}" in topics), None)
        if leaf is not None and "/landmarks" in topics:
            yield prefix, topics[f"{prefix}/{leaf}"]


def _find(_: str, topics: Mapping[str, Topic], parameters: SetParameters) -> Iterator[Binding]:
    for prefix, topic in bearings_in(topics, LEAVES):
        landmarks = topics["/landmarks"]
        known = known_of(topic, landmarks, parameters)
        yield Binding({"seen": topic}, {"/landmarks": landmarks}, prefix, setup=known)


def known_of(topic: Topic, landmarks: Topic, parameters: SetParameters) -> Known:
    """Read bounds and arena from the parameters; read missing ones from the metadata of channels."""
    bound_rad = None if parameters.bound_deg is None else float(np.radians(parameters.bound_deg))
    arena_m: tuple[float, ...] | None = parameters.arena_m
    if arena_m is None and "arena_m" in landmarks.metadata:
        arena_m = _numbers(landmarks, "arena_m")
    if arena_m is not None and not (len(arena_m) == 4 and np.all(np.less(arena_m[:2], arena_m[2:]))):
        raise BadInput(
            f"arena_m = {arena_m}: expected low x, low y, high x, high y; set it with --set "
            f"arena_m=[...] or in the metadata of {landmarks.name}"
        )
    range_m = parameters.maximum_range_m
    if range_m is None and "maximum_range_m" in topic.metadata:
        range_m = _numbers(topic, "maximum_range_m")[0]
    if bound_rad is None and "bound_rad" in topic.metadata:
        bound_rad = _numbers(topic, "bound_rad")[0]
    if bound_rad is None:
        raise BadInput(
            f"topic {topic.name}: the bound of its relative bearings is unknown; set it with --set "
            "bound_deg=..., in degrees, or state bound_rad on its channel"
        )
    return Known(bound_rad, parameters.least_landmarks, arena_m, range_m)


def _numbers(topic: Topic, name: str) -> tuple[float, ...]:
    """Read finite numbers, separated by commas, from a channel's metadata."""
    try:
        numbers = tuple(float(part) for part in topic.metadata[name].split(","))
    except ValueError:
        numbers = (np.nan,)
    if not np.isfinite(numbers).all():
        raise BadInput(f"topic {topic.name}: {name} is '{topic.metadata[name]}'; it must be numbers")
    return numbers


SET_MEMBERSHIP = batch(
    "guaranteed sets of positions from bounded relative bearings: exact, box, l4, l8",
    parameters=SetParameters,
    find=_find,
    requirements="/landmarks and one of .../relative_bearing, range_bearing, bearing",
    solve=solve,
    variant="shape",
)
