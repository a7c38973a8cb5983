"""Evaluation of regions that should contain a position: area, and containment of the truth."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.sets.regions.feasible_sets import signed_area
from fuselog.replay.judging.errors.evaluation import reference, split_topic
from fuselog.replay.judging.errors.truths import Truths

PLACE: Components = {"x_m": "linear", "y_m": "linear"}


class Regions(NamedTuple):
    """Regions (n,) of one estimator and case, for an ensemble or a block of it.

    `holds` marks regions that contain the truth, if it is `known`; an empty region has area 0.
    """

    estimator: str
    case: str
    area_m2: Floats
    known: NDArray[np.bool_]
    holds: NDArray[np.bool_]


def regions_of(
    outputs: Mapping[str, Ragged], truths: Sequence[Truths], gap_limit_s: float
) -> dict[str, Regions]:
    """Judge the regions in a replay's outputs, or in a block; keys are the topics of region sizes."""
    found = {}
    for topic, sizes in outputs.items():
        base = topic.removesuffix("size")
        sets = outputs.get(f"{base}set")
        if sets is None or sets.stream.schema.full_name != schemas.SET_ESTIMATE.full_name:
            continue
        places = places_at(sizes, truths, gap_limit_s)
        rings = rings_of(sizes.stream, sets.stream)
        known: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=1))
        holds = inside(rings, places)
        found[topic] = Regions(*split_topic(topic), areas_of(rings), known, holds)
    return found


def places_at(sizes: Ragged, truths: Sequence[Truths], gap_limit_s: float) -> Floats:
    """Find the true positions (n, 2) at the stamps of regions; NaN if unknown."""
    topic = sizes.stream.metadata.get("truth", "")
    return np.concatenate(
        [
            reference(each, topic, PLACE, sizes.of_run(run), gap_limit_s)
            if topic in each.topics
            else np.full((len(sizes.of_run(run)), 2), np.nan)
            for run, each in enumerate(truths)
        ]
    )


def rings_of(sizes: Stream, sets: Stream) -> list[list[Floats]]:
    """Split the vertices into the rings (n, 2) of every region; an empty region has no rings."""
    ends = np.cumsum(sizes["elements"].astype(np.int64))
    ring, vertex = sets["ring_id"].astype(np.int64), sets["vertex"]
    found = []
    for first, end in zip(np.append(0, ends)[:-1], ends, strict=True):
        cuts = np.flatnonzero(np.diff(ring[first:end])) + 1
        found.append(np.split(vertex[first:end], cuts) if end > first else [])
    return found


def areas_of(regions: Sequence[Sequence[Floats]]) -> Floats:
    """Compute the area (n,) inside the rings of every region; holes have the opposite orientation."""
    return np.array([abs(sum(map(signed_area, rings))) for rings in regions])


def inside(regions: Sequence[Sequence[Floats]], places: Floats) -> NDArray[np.bool_]:
    """Test whether each region contains its position.

    Args:
        regions: n lists of rings, (vertices, 2) in m each.
        places: (n, 2), in m; no region contains a NaN position.

    Returns:
        (n,) booleans.
    """
    from matplotlib.path import Path  # slow to import

    found = np.zeros(len(places), bool)
    for row, rings in enumerate(regions):
        for ring in rings:
            found[row] ^= Path(ring, closed=False).contains_point(places[row])
    return found
