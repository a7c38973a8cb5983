"""Judges sets by truth: area, whether the true position is inside, how often there is no set."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from replay.engine.streams.blocks import Ragged, run_of_rows
from replay.engine.streams.sources import Source
from replay.engine.vectors.components import Components
from replay.judging.errors.evaluation import reference, split_topic
from replay.judging.errors.truths import Truths
from replay.regions.feasible_sets import excess_rad, signed_area
from replay.regions.frames import Known, frames

Floats = NDArray[np.float64]

PLACE: Components = {"x_m": "linear", "y_m": "linear"}


@dataclass(frozen=True)
class JudgedSets:
    """Holds the sets of one estimator and case, a row per frame.

    `inside` says whether the truth is in the set, where it is `known`, `in_arena` whether it is where
    the robot was taken to be, and `bound_holds` whether all relative bearings of the frame keep their
    bound there; an empty set has area 0.
    """

    estimator: str
    case: str
    run: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    area_m2: Floats
    known: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    in_arena: NDArray[np.bool_]
    bound_holds: NDArray[np.bool_]
    faults: int

    @property
    def violations(self) -> int:
        """Count the sets that miss the truth although bounds and arena hold: none if guaranteed."""
        return int((self.known & self.bound_holds & self.in_arena & ~self.inside).sum())

    @property
    def outside_arena(self) -> int:
        """Count how often the robot was not where it was taken to be, so that nothing is guaranteed."""
        return int((self.known & ~self.in_arena).sum())


def frames_of(sizes: Stream, sets: Stream) -> list[list[Floats]]:
    """Return the rings (n, 2) of every frame; none where its set is empty."""
    ends = np.cumsum(sizes["elements"].astype(np.int64))
    ring, vertex = sets["ring_id"].astype(np.int64), sets["vertex"]
    frames = []
    for first, end in zip(np.append(0, ends)[:-1], ends, strict=True):
        cuts = np.flatnonzero(np.diff(ring[first:end])) + 1
        frames.append(np.split(vertex[first:end], cuts) if end > first else [])
    return frames


def areas_of(frames: Sequence[Sequence[Floats]]) -> Floats:
    """Return the area (n,) inside the rings of every frame; holes run the other way round."""
    return np.array([abs(sum(map(signed_area, rings))) for rings in frames])


def judge_sets(
    outputs: dict[str, Ragged], sources: Sequence[Source], gap_limit_s: float
) -> list[JudgedSets]:
    """Judge every set estimate of a replay against the truth that its channel names."""
    found = []
    for topic, sizes in outputs.items():
        if sizes.stream.schema.full_name == schemas.ESTIMATE_SIZE.full_name and topic.endswith("/size"):
            base = topic.removesuffix("size")
            if f"{base}set" in outputs:
                fault = outputs[f"{base}fault"]
                found.append(_judge(sizes, outputs[f"{base}set"], len(fault), sources, gap_limit_s))
    return found


def _judge(
    sizes: Ragged, sets: Ragged, faults: int, sources: Sequence[Source], gap_limit_s: float
) -> JudgedSets:
    from matplotlib.path import Path  # which takes long to import

    run = run_of_rows(sizes.offsets)
    topic = sizes.stream.metadata["truth"]
    truth = [
        reference(Truths(source), topic, PLACE, sizes.of_run(number), gap_limit_s)
        for number, source in enumerate(sources)
    ]
    places = np.concatenate(truth)
    in_arena, bound_holds = np.concatenate(
        [
            premises_hold(sizes.of_run(number), source, truth[number])
            for number, source in enumerate(sources)
        ],
        axis=1,
    )
    sets_of_frames = frames_of(sizes.stream, sets.stream)
    inside = np.zeros(len(places), bool)
    for frame, rings in enumerate(sets_of_frames):
        for ring in rings:
            inside[frame] ^= Path(ring, closed=False).contains_point(places[frame])
    estimator, case = split_topic(sizes.stream.topic)
    return JudgedSets(
        estimator,
        case,
        run,
        sizes.stream.publish_time_ns,
        areas_of(sets_of_frames),
        np.asarray(np.isfinite(places).all(axis=1)),
        inside,
        in_arena,
        bound_holds,
        faults,
    )


def premises_hold(sizes: Stream, source: Source, places: Floats) -> NDArray[np.bool_]:
    """Tell whether the places (frames, 2) are in each frame's arena, and keep its bound: (2, frames).

    Args:
        sizes: the sets of one run, a message per frame.
        source: the run.
        places: (frames, 2), true positions in m.
    """
    measured = sizes.metadata["measured"]
    streams = source.read(["/landmarks", measured])
    hold = np.zeros((2, len(places)), bool)
    row_of = {time_ns: row for row, time_ns in enumerate(sizes.publish_time_ns.tolist())}
    for frame in frames(streams[measured], streams["/landmarks"], Known.of(sizes.metadata)):
        row = row_of.get(frame.time_ns)  # none outside the span that was replayed
        if row is not None:
            hold[0, row] = np.all((frame.arena.low <= places[row]) & (places[row] <= frame.arena.high))
            hold[1, row] = np.all(excess_rad(frame.pairs, places[row]) <= 0)
    return hold
