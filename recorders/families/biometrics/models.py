"""Biometric matchers, and their scores for each probe and gallery entry, as columns.

Probe i and gallery entry i are of the same user. Scores are stored as the matcher gave them; the
stream's metadata state which matchers give distances, and the score that marks a failure to enrol.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.parameters import Parameters

TOPIC = "/scores"
# Used in file names, topics and comma-separated lists.
Name = Annotated[str, Field(pattern=r"^[^/,\s]+$")]


class Matcher(Parameters):
    """A matcher of biometric samples.

    Attributes:
        name: name of the matcher.
        modality: kind of biometric sample, such as face.
        score: whether a larger score means more similar or more different samples.
        failure: score that marks a failure to enrol; if not set, there are no failures.
    """

    name: Name
    modality: Name
    score: Literal["similarity", "distance"] = "similarity"
    failure: float | None = None


class Comparisons(NamedTuple):
    """All comparisons of one run: scores (users, users, matchers) by probe and gallery entry.

    Distances are negated, so that a greater score means more similar. `failed` marks failures to enrol;
    `arrival_ns` (users,) are the arrival times of the probes.
    """

    matchers: tuple[Matcher, ...]
    scores: NDArray[np.float64]
    failed: NDArray[np.bool_]
    arrival_ns: NDArray[np.int64]


def score_stream(
    matchers: Sequence[Matcher], scores: NDArray[np.float64], arrival_ns: ArrayLike
) -> Stream:
    """Make the stream of scores (users, users, matchers), probe by probe in order of arrival (users,).

    Args:
        matchers: the matchers, in the order of the scores' last axis.
        scores: (users, users, matchers), by probe and gallery entry.
        arrival_ns: (users,), arrival times of the probes.

    Returns:
        The stream, whose metadata describe the matchers.
    """
    users = len(scores)
    metadata = {
        "matchers": ",".join(each.name for each in matchers),
        "modalities": ",".join(each.modality for each in matchers),
        "senses": ",".join(each.score for each in matchers),
        "failure_scores": ",".join(
            "" if each.failure is None else repr(each.failure) for each in matchers
        ),
    }
    return make_stream(
        TOPIC,
        schemas.SCORE_VECTOR,
        np.repeat(arrival_ns, users),
        metadata=metadata,
        probe_id=np.repeat(np.arange(users), users),
        gallery_id=np.tile(np.arange(users), users),
        scores=scores.reshape(users * users, len(matchers)),
    )


def matchers_of(metadata: Mapping[str, str]) -> tuple[Matcher, ...]:
    """Return the matchers in a score stream's metadata; raise BadInput if these are inconsistent."""
    keys = ("matchers", "modalities", "senses", "failure_scores")
    try:
        rows = zip(*(metadata[key].split(",") for key in keys), strict=True)
        return tuple(
            Matcher(name=name, modality=modality, score=sense, failure=float(failed) if failed else None)
            for name, modality, sense, failed in rows
        )
    except (KeyError, ValueError):
        raise BadInput(
            f"topic {TOPIC}: the metadata {', '.join(keys)} must have one entry per matcher; "
            "record the scores again"
        ) from None


def comparisons_of(stream: Stream) -> Comparisons:
    """Read a score stream as matrices; raise BadInput if a pair of users is missing or repeated."""
    matchers = matchers_of(stream.metadata)
    probe, gallery = (stream[name].astype(np.int64) for name in ("probe_id", "gallery_id"))
    users = int(max(probe.max(initial=-1), gallery.max(initial=-1))) + 1
    pairs = probe * users + gallery
    if len(stream) != users**2 or not (np.bincount(pairs) == 1).all():
        raise BadInput(
            f"topic {stream.topic}: {len(stream)} score vectors, {len(np.unique(pairs))} of them of "
            f"different pairs, for {users} users; every probe must be compared with every gallery entry "
            "exactly once"
        )
    scores = np.empty((users, users, len(matchers)))
    scores[probe, gallery] = stream["scores"]
    failures = np.array([np.nan if each.failure is None else each.failure for each in matchers])
    failed = (scores == failures) | np.isnan(scores)
    senses = np.array([1.0 if each.score == "similarity" else -1.0 for each in matchers])
    arrival_ns = np.zeros(users, np.int64)
    arrival_ns[probe] = stream.publish_time_ns
    return Comparisons(matchers, scores * senses, failed, arrival_ns)
