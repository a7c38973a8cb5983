"""Failures of runs that an estimator could not process to the end, with time and reason.

A failure is a message whose only field is an index in a list of sentences; the channel's metadata
contains this list as JSON. When streams are joined, their lists are merged.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from textwrap import shorten
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Schema, Stream, make_stream, schemas
from fuselog.recorders.log.streams import concatenate, empty_stream

REASONS = "reasons"
UNSTATED = "no reason given"


class Failure(NamedTuple):
    """Time and reason of the failure of a run."""

    time_ns: int
    reason: str


def reason_of(error: Exception) -> str:
    """Return the text of an exception; for fuselog's own exceptions, only the message."""
    if isinstance(error, BadInput) and error.__cause__ is None:
        return str(error)
    raised = error.__cause__ if isinstance(error, BadInput) else error
    return shorten(f"{type(raised).__name__}: {raised}", 200)


def failure_stream(topic: str, failures: Sequence[Failure]) -> Stream:
    """Make a stream with one message for each failure.

    Args:
        topic: topic of the stream.
        failures: time and reason of each failure.
    """
    if not failures:
        return empty_stream(topic, schemas.FAILURE, {REASONS: "[]"})
    reasons = list(dict.fromkeys(failure.reason for failure in failures))
    return reason_stream(
        topic,
        schemas.FAILURE,
        np.array([failure.time_ns for failure in failures], np.int64),
        np.array([reasons.index(failure.reason) for failure in failures], np.int64),
        reasons,
    )


def reason_stream(
    topic: str,
    schema: Schema,
    time_ns: NDArray[np.int64],
    reason: NDArray[np.int64],
    reasons: Iterable[str],
) -> Stream:
    """Make a stream of messages (n,) whose only field, `reason`, is an index in a list of sentences.

    Args:
        topic: topic of the stream.
        schema: a schema with the field `reason`.
        time_ns: (n,) stamps.
        reason: (n,) indices in the list of sentences.
        reasons: the sentences.
    """
    return make_stream(
        topic, schema, time_ns, metadata={REASONS: json.dumps(list(reasons))}, reason=reason
    )


def sentences_of(stream: Stream) -> list[str]:
    """Return the reason of every message of a stream made by `reason_stream`.

    Raises BadInput if the channel's list is not a JSON list of sentences, as in logs older than version
    0.1.0.
    """
    reasons = _reasons(stream)
    return [
        reasons[number] if number < len(reasons) else UNSTATED for number in stream["reason"].tolist()
    ]


def join_streams(parts: Sequence[Stream]) -> Stream:
    """Join parts of one topic in the given order; different lists of reasons are merged.

    Raises BadInput as `concatenate` and `sentences_of` do.
    """
    if len(parts) == 1 or len({part.metadata.get(REASONS) for part in parts}) == 1:
        return concatenate(parts)
    lists = [_reasons(part) for part in parts]
    merged = list(dict.fromkeys(reason for each in lists for reason in each))
    metadata = {REASONS: json.dumps(merged)}
    return concatenate([_renumbered(part, merged, metadata) for part in parts])


def _renumbered(part: Stream, merged: list[str], metadata: Mapping[str, str]) -> Stream:
    """Renumber a part's reasons by the merged list; invalid indices stay out of range."""
    places = np.array([*map(merged.index, _reasons(part)), len(merged)])
    numbers = places[np.minimum(part["reason"].astype(np.int64), len(places) - 1)]
    columns = {**part.columns, "reason": numbers.astype(part["reason"].dtype)}
    return replace(part, columns=columns, metadata={**part.metadata, **metadata})


def _reasons(stream: Stream) -> list[str]:
    text = stream.metadata.get(REASONS, "[]")
    try:
        reasons = json.loads(text)
    except (ValueError, RecursionError):
        reasons = None
    if not isinstance(reasons, list) or not all(isinstance(reason, str) for reason in reasons):
        raise BadInput(
            f"topic {stream.topic}: its reasons are not a JSON list of sentences; replay the log again "
            "with this version of fuselog"
        )
    return reasons
