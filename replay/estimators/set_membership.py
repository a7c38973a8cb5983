"""Guaranteed position fixes from bounded relative bearings, one set per frame of one stamp.

Briechle, Hanebeck (2004). The estimate is the set itself: the exact one, its tightest box, or the
pseudo-ellipsoids with L = 4 and L = 8. An empty set is a fault; the relative bearing to blame is
repeated on the fault's topic.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveInt

from recorders.errors import BadInput
from recorders.log import Stream, Topic, make_stream, schemas
from recorders.models.planar import wrap_angle
from recorders.parameters import Parameters
from replay.blocks import Ragged
from replay.engine import Batch, Bound, Estimator
from replay.estimators.feasible_sets import (
    Arena,
    Floats,
    Pairs,
    arena_around,
    box,
    exact_set,
    make_pairs,
    rings,
    to_blame,
)
from replay.estimators.pseudo_ellipsoids import Weighting, fit, outline
from replay.measurements import PLANE, read_vectors

LEAVES = ("relative_bearing", "range_bearing", "bearing")


class SetParameters(Parameters):
    """Which set, and from what; a bound or an arena that is None is the one that the log states.

    Bearings of one stamp give all their pairs. Without an arena in the log it is the rectangle around
    the landmarks with `arena_margin_m`.
    """

    shape: Literal["exact", "box", "l4", "l8"] = "exact"
    bound_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    weighting: Weighting = "area"
    sweeps: PositiveInt = 1
    least_landmarks: Annotated[int, Field(ge=2)] = 3
    arena_margin_m: NonNegativeFloat = 1.25


class Frame(NamedTuple):
    """The relative bearings of one stamp and the numbers (n, 2) of their landmarks."""

    time_ns: int
    pairs: Pairs
    numbers: NDArray[np.int64]


def frames(
    stream: Stream, landmarks: Mapping[int, Floats], bound_rad: float, least_landmarks: int
) -> Iterator[Frame]:
    """The frames of a bearing, range-bearing or relative-bearing stream that see enough landmarks.

    What is not on the map is left out, and so are pairs of one landmark seen twice.
    """
    cuts = np.flatnonzero(np.diff(stream.publish_time_ns)) + 1
    for rows in np.split(np.arange(len(stream)), cuts):
        if "angle_rad" in stream.columns:
            numbers = np.stack([stream["first_id"][rows], stream["second_id"][rows]], axis=1)
            angle = stream["angle_rad"][rows]
        else:
            first, second = np.triu_indices(len(rows), 1)
            targets, bearing = stream["target_id"][rows], stream["bearing_rad"][rows]
            numbers = np.stack([targets[first], targets[second]], axis=1)
            angle = wrap_angle(bearing[first] - bearing[second])
        mapped = np.isin(numbers, list(landmarks)).all(axis=1) & (numbers[:, 0] != numbers[:, 1])
        numbers, angle = numbers[mapped].astype(np.int64), angle[mapped]
        if len(np.unique(numbers)) < least_landmarks:
            continue
        first, second = (np.array([landmarks[int(n)] for n in side]) for side in numbers.T)
        time_ns = int(stream.publish_time_ns[rows[0]])
        yield Frame(time_ns, make_pairs(first, second, angle, bound_rad), numbers)


def map_and_arena(landmarks: Stream, margin_m: float) -> tuple[dict[int, Floats], Arena]:
    """The landmarks by number and the arena that the log states, or the one around them."""
    places = read_vectors(landmarks, "position_m", PLANE)
    numbers = landmarks["landmark_id"].tolist()
    stated = landmarks.metadata.get("arena_m")
    if stated is None:
        return dict(zip(numbers, places, strict=True)), arena_around(places, margin_m)
    try:
        low_x, low_y, high_x, high_y = (float(part) for part in stated.split(","))
    except ValueError:
        raise BadInput(
            f"topic {landmarks.topic}: arena_m is '{stated}'; low x, low y, high x, high y are needed"
        ) from None
    return dict(zip(numbers, places, strict=True)), Arena(
        np.array([low_x, low_y]), np.array([high_x, high_y])
    )


def polygons(pairs: Pairs, arena: Arena, parameters: SetParameters) -> list[Floats]:
    """The border of the chosen set of one frame; none where it is empty."""
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


def solve(
    whole: Mapping[str, Ragged],
    *,
    name: str,
    topic: str,
    truth: str,
    bound_rad: float,
    parameters: SetParameters,
) -> list[Ragged]:
    """A set for every frame of every run; see `replay.engine.Batch`."""
    sets, sizes, faults = _Rows(), _Rows(), _Rows()
    landmarks, seen = whole["/landmarks"], whole[topic]
    for run in range(seen.runs):
        known, arena = map_and_arena(landmarks.of_run(run), parameters.arena_margin_m)
        for frame in frames(seen.of_run(run), known, bound_rad, parameters.least_landmarks):
            found = polygons(frame.pairs, arena, parameters)
            sizes.add(run, frame.time_ns, [sum(map(len, found))])
            for number, ring in enumerate(found):
                sets.add(run, frame.time_ns, np.full(len(ring), number), ring)
            if not found:
                blamed = to_blame(frame.pairs, arena)[:1]
                faults.add(run, frame.time_ns, frame.numbers[blamed], frame.pairs.angle_rad[blamed])
    prefix = f"/estimates/{name}"
    metadata = {
        "components": "x_m,y_m",
        "kinds": "linear,linear",
        "truth": truth,
        "measured": topic,
        "bound_rad": repr(bound_rad),
        "least_landmarks": str(parameters.least_landmarks),
    }
    ring_id, vertex = sets.columns([(0,), (0, 2)])
    (elements,) = sizes.columns([(0,)])
    pair, angle = faults.columns([(0, 2), (0,)])
    return [
        sets.ragged(
            f"{prefix}/set", schemas.SET_ESTIMATE, seen.runs, metadata, ring_id=ring_id, vertex=vertex
        ),
        sizes.ragged(f"{prefix}/size", schemas.ESTIMATE_SIZE, seen.runs, metadata, elements=elements),
        faults.ragged(
            f"{prefix}/fault",
            schemas.RELATIVE_BEARING,
            seen.runs,
            {"purpose": "the set is empty; this relative bearing is to blame"},
            first_id=pair[:, 0],
            second_id=pair[:, 1],
            angle_rad=angle,
        ),
    ]


class _Rows:
    """Messages of one topic while they are collected, run by run."""

    def __init__(self) -> None:
        self._run: list[NDArray[np.int64]] = []
        self._time_ns: list[NDArray[np.int64]] = []
        self._parts: list[tuple[Any, ...]] = []

    def add(self, run: int, time_ns: int, *parts: Any) -> None:
        self._run.append(np.full(len(parts[0]), run))
        self._time_ns.append(np.full(len(parts[0]), time_ns))
        self._parts.append(parts)

    def columns(self, empty: list[tuple[int, ...]]) -> list[NDArray[Any]]:
        if not self._parts:
            return [np.empty(shape) for shape in empty]
        return [np.concatenate(column) for column in zip(*self._parts, strict=True)]

    def ragged(
        self,
        topic: str,
        schema: schemas.Schema,
        runs: int,
        metadata: Mapping[str, str],
        **columns: NDArray[Any],
    ) -> Ragged:
        none = [np.empty(0, np.int64)]
        run, time_ns = (np.concatenate(part or none) for part in (self._run, self._time_ns))
        stream = make_stream(topic, schema, time_ns, metadata=metadata, **columns)
        return Ragged(stream, np.searchsorted(run, np.arange(runs + 1)))


def _bind(name: str, topics: Mapping[str, Topic], parameters: SetParameters) -> list[Bound]:
    bound: list[Bound] = []
    if "/landmarks" not in topics:
        return bound
    for prefix in dict.fromkeys(topic.rpartition("/")[0] for topic in topics):
        leaf = next((leaf for leaf in LEAVES if f"{prefix}/{leaf}" in topics), None)
        if leaf is None:
            continue
        topic = topics[f"{prefix}/{leaf}"]
        work: Any = partial(
            solve,
            name=f"{name}{prefix}",
            topic=topic.name,
            truth=f"{prefix}/truth",
            bound_rad=_bound_rad(topic, parameters),
            parameters=parameters,
        )
        bound.append(Batch(f"{name}{prefix}", (topic.name,), ("/landmarks",), work))
    return bound


def _bound_rad(topic: Topic, parameters: SetParameters) -> float:
    if parameters.bound_deg is not None:
        return float(np.radians(parameters.bound_deg))
    try:
        return float(topic.metadata["bound_rad"])
    except (KeyError, ValueError):
        raise BadInput(
            f"topic {topic.name} does not state bound_rad; give it with --set bound_deg=..."
        ) from None


SET_MEMBERSHIP = Estimator(
    "guaranteed sets of positions from bounded relative bearings: exact, box, l4, l8",
    "/landmarks and one of .../relative_bearing, range_bearing, bearing",
    SetParameters,
    _bind,
    variant="shape",
)
