"""Evaluation of sets against the truth: area, containment of the true position, and empty sets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.families.sets.judging.regions import areas_of, inside, places_at, rings_of
from fuselog.replay.families.sets.regions.feasible_sets import excess_rad
from fuselog.replay.families.sets.regions.frames import Known, frames
from fuselog.replay.judging.errors.evaluation import split_topic
from fuselog.replay.judging.errors.truths import Truths

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class JudgedSets:
    """Sets of one estimator and case, with one row per frame.

    `inside` marks sets that contain the truth, if it is `known`; `in_arena` marks frames in which the
    robot is in its assumed arena; `bound_holds` marks frames in which the errors of all relative
    bearings are within the bound. An empty set has area 0.
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
        """Count sets that miss the truth although bounds and arena are valid; 0 for guaranteed sets."""
        return int((self.known & self.bound_holds & self.in_arena & ~self.inside).sum())

    @property
    def outside_arena(self) -> int:
        """Count the frames without a guarantee because the robot is outside the assumed arena."""
        return int((self.known & ~self.in_arena).sum())


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
    run = run_of_rows(sizes.offsets)
    places = places_at(sizes, [Truths(source) for source in sources], gap_limit_s)
    in_arena, bound_holds = np.concatenate(
        [
            premises_hold(sizes.of_run(number), source, places[run == number])
            for number, source in enumerate(sources)
        ],
        axis=1,
    )
    rings = rings_of(sizes.stream, sets.stream)
    estimator, case = split_topic(sizes.stream.topic)
    return JudgedSets(
        estimator,
        case,
        run,
        sizes.stream.publish_time_ns,
        areas_of(rings),
        np.asarray(np.isfinite(places).all(axis=1)),
        inside(rings, places),
        in_arena,
        bound_holds,
        faults,
    )


def premises_hold(sizes: Stream, source: Source, places: Floats) -> NDArray[np.bool_]:
    """Test whether the true position is in the arena and within the bounds, for each frame: (2, frames).

    Args:
        sizes: the numbers of vertices of the sets of one run, one message per frame.
        source: the run.
        places: (frames, 2), true positions in m.
    """
    measured = sizes.metadata["measured"]
    streams = source.read(["/landmarks", measured])
    hold = np.zeros((2, len(places)), bool)
    row_of = {time_ns: row for row, time_ns in enumerate(sizes.publish_time_ns.tolist())}
    for frame in frames(streams[measured], streams["/landmarks"], Known.of(sizes.metadata)):
        row = row_of.get(frame.time_ns)  # None outside the replayed span
        if row is not None:
            hold[0, row] = np.all((frame.arena.low <= places[row]) & (places[row] <= frame.arena.high))
            hold[1, row] = np.all(excess_rad(frame.pairs, places[row]) <= 0)
    return hold
