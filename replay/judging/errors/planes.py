"""Test whether estimates and their truth are in local tangent planes that can be compared."""

from collections.abc import Mapping, Sequence

import numpy as np

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.planes import (
    FRAME,
    Origin,
    frame_in_words,
    frame_of,
    is_planar,
    plane_in_words,
    stated_in,
)
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.geodetic import origins_of
from fuselog.replay.engine.streams.sources import Source

ALIGNED = "aligned"  # in the metadata of estimates that were aligned with the frame of the truth
# By estimator and case, as in topics, the first fix of every run, which is the origin of its tangent
# plane.
FirstFixes = Mapping[str, Sequence[Origin | None]]


def first_fixes(outputs: Mapping[str, Ragged]) -> dict[str, list[Origin | None]]:
    """Read the first fix of every run from a replay's outputs, as the origin that no channel states."""
    return {
        topic.rpartition("/")[0]: [
            Origin(*map(float, place)) if np.isfinite(place).all() else None
            for place in origins_of(rows)
        ]
        for topic, rows in outputs.items()
        if topic.endswith("/origin")
        and topic.startswith("/estimates/")
        and rows.stream.schema.full_name == schemas.GEODETIC_FIX.full_name
    }


def planes_of(stream: Stream, runs: int, first: FirstFixes) -> list[Origin | None]:
    """Return the origin of the estimates' tangent plane in every run; None if it is not known."""
    stated = stated_in(stream.topic, stream.metadata)
    if stated is None:
        return list(first.get(stream.topic.rpartition("/")[0], [None] * runs))
    return [stated] * runs


def unlike(stream: Stream, sources: Sequence[Source], first: FirstFixes) -> str:
    """Explain why estimates cannot be compared with the truth of some run, or return "".

    Tangent planes with known origins can be compared. If a truth states no origin but its log does, the
    truth is in the tangent plane of the log, unless the truth has a separate frame. Estimates of a
    filter whose origin is the first fix are not in this tangent plane.

    Args:
        stream: the estimates.
        sources: the runs.
        first: see `first_fixes`.
    """
    topic, frame = stream.metadata.get("truth", ""), frame_of(stream.metadata)
    if not is_planar(stream.schema.full_name, stream.metadata) or ALIGNED in stream.metadata:
        return ""
    for source, own in zip(sources, planes_of(stream, len(sources), first), strict=True):
        truth = source.topics.get(topic)
        if truth is None or not is_planar(truth.schema_name, truth.metadata):
            continue
        is_first = own is not None and stated_in(stream.topic, stream.metadata) is None
        if stated_in(topic, truth.metadata) is None:
            if own is not None and (is_first or truth.metadata.get(FRAME)):
                at = "the first fix" if is_first else "their origin"
                return (
                    f"{topic} does not state the origin of its tangent plane, and the estimates are "
                    f"relative to {own}, {at}; give it with --set "
                    f"{topic}.plane=LATITUDE,LONGITUDE,HEIGHT, or align the estimates with "
                    "fuselog evaluate --align se2"
                )
            of_truth = frame_of(truth.metadata)
            if own is None and frame != of_truth:
                own_frame, other = frame_in_words(frame), frame_in_words(of_truth)
                return (
                    f"they are in {own_frame}, and {topic} is in {other}; align them with "
                    "fuselog evaluate --align se2"
                )
        elif own is None and frame:
            return (
                f"they are in {plane_in_words(stream.metadata)}, and {topic} is relative to an origin "
                "on earth; align them with fuselog evaluate --align se2"
            )
    return ""
