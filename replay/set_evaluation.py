"""Sets against truth: area, whether the true position is inside, and how often there is no set."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from recorders.log import Stream, schemas
from replay.blocks import Ragged
from replay.estimators.feasible_sets import signed_area
from replay.evaluation import split_topic, truth_at
from replay.sources import Source

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class JudgedSets:
    """The sets of one estimator and case, a row per frame.

    `inside` says whether the truth is in the set, where it is `known`; an empty set has area 0.
    """

    estimator: str
    case: str
    run: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    area_m2: Floats
    known: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    faults: int


def frames_of(sizes: Stream, sets: Stream) -> list[list[Floats]]:
    """The rings (n, 2) of every frame; none where its set is empty."""
    ends = np.cumsum(sizes["elements"].astype(np.int64))
    ring, vertex = sets["ring_id"].astype(np.int64), sets["vertex"]
    frames = []
    for first, end in zip(np.append(0, ends[:-1]), ends, strict=True):
        cuts = np.flatnonzero(np.diff(ring[first:end])) + 1
        frames.append(np.split(vertex[first:end], cuts) if end > first else [])
    return frames


def areas_of(frames: Sequence[Sequence[Floats]]) -> Floats:
    """The area (n,) inside the rings of every frame; holes run the other way round."""
    return np.array([abs(sum(map(signed_area, rings))) for rings in frames])


def judge_sets(
    outputs: dict[str, Ragged], sources: Sequence[Source], gap_limit_s: float
) -> list[JudgedSets]:
    """Every set estimate of a replay against the truth that its channel names."""
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
    run = np.repeat(np.arange(sizes.runs), np.diff(sizes.offsets))
    topic = sizes.stream.metadata["truth"]
    truth = [
        truth_at(
            source.read([topic])[topic],
            sizes.of_run(number).publish_time_ns,
            source.topics[topic].metadata.get("kinds", "linear,linear").split(","),
            gap_limit_s,
        )[:, :2]
        for number, source in enumerate(sources)
    ]
    places = np.concatenate(truth)
    frames = frames_of(sizes.stream, sets.stream)
    inside = np.zeros(len(frames), bool)
    for frame, rings in enumerate(frames):
        for ring in rings:
            inside[frame] ^= Path(ring, closed=False).contains_point(places[frame])
    estimator, case = split_topic(sizes.stream.topic)
    known = np.asarray(np.isfinite(places).all(axis=1))
    time_ns = sizes.stream.publish_time_ns
    return JudgedSets(estimator, case, run, time_ns, areas_of(frames), known, inside, faults)
