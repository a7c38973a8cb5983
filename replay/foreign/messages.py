"""Conversion of messages to rows of numbers for foreign filters, and of filter results to streams."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Stream, Topic
from fuselog.recorders.log.streams import check_stream
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Block, Ragged, by_runs
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.measurements import check_width
from fuselog.replay.engine.streams.results import failures_by_run, state_stream
from fuselog.replay.foreign.description import Description, TopicRead
from fuselog.replay.foreign.native.following import Followed, Static
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    FilterEvents,
    InnovationRows,
    recorded_innovations,
)
from fuselog.replay.inference.run.timing import at_stamps_of


def numbers_of(topic: TopicRead, stream: Stream, width: int) -> Floats:
    """Combine the fields of a topic in rows (n, width), padded with NaN.

    Raises BadInput if a field is missing.
    """
    data, column = np.full((len(stream), width), np.nan), 0
    for field, size in topic.sizes.items():
        if field not in stream.columns:
            raise BadInput(
                f"topic {stream.topic}: has no field {field}, which the filter reads; "
                f"{choices(field, stream.columns)}"
            )
        values = stream[field]
        if not len(stream):
            continue
        if values.ndim == 1 and size:
            raise BadInput(
                f"topic {stream.topic}: {field} is one number, not a vector of {size}; name it {field}"
            )
        check_width(stream, field, size or 1) if values.ndim == 2 else None
        data[:, column : column + (size or 1)] = values.reshape(len(stream), -1)
        column += size or 1
    return data


def static_of(
    description: Description, found: Mapping[str, Topic], given: Mapping[str, Ragged], runs: int
) -> Static:
    """Combine the messages of the static topics in all runs, topic by topic."""
    parts = [
        (number, topic, given[found[topic.topic].name])
        for number, topic in enumerate(description.topics)
        if topic.static and topic.topic in found
    ]
    nothing = Static(
        np.zeros(runs + 1, np.int64),
        np.empty(0, np.int64),
        np.empty(0, np.int64),
        np.empty((0, description.width)),
    )
    if not parts:
        return nothing
    order, offsets = by_runs([each.offsets for _, _, each in parts])
    return Static(
        offsets,
        np.concatenate([each.stream.publish_time_ns for _, _, each in parts])[order],
        np.concatenate([np.full(len(each), number) for number, _, each in parts])[order],
        np.concatenate([numbers_of(topic, each.stream, description.width) for _, topic, each in parts])[
            order
        ],
    )


def static_of_run(static: Static, run: int) -> Static:
    """Return the static messages of one run."""
    begin, end = static.offsets[run : run + 2].tolist()
    return Static(
        np.array([0, end - begin]),
        static.time_ns[begin:end],
        static.source[begin:end],
        static.data[begin:end],
    )


def events_of(description: Description, found: Mapping[str, Topic], block: Block) -> FilterEvents:
    """Convert the messages of a block to events with indices of the topics in the description."""
    numbers = {
        found[each.topic].name: number
        for number, each in enumerate(description.topics)
        if each.topic in found
    }
    tables, targets, sources = [], [], []
    for name, ragged in block.streams.items():
        topic = description.topics[numbers[name]]
        tables.append(numbers_of(topic, ragged.stream, description.width))
        target = ragged[topic.target] if topic.target else np.zeros(len(ragged))
        targets.append(target.astype(np.int64))
        sources.append(numbers[name])
    merged = block.events
    source = np.array(sources)[merged.topic]
    wanted = at_stamps_of(
        merged.is_last, np.array([each.estimates for each in description.topics])[source]
    )
    return FilterEvents(
        merged.offsets,
        merged.time_ns,
        source,
        np.ascontiguousarray(np.concatenate(tables)[merged.source]),
        wanted,
        np.concatenate(targets)[merged.source],
        np.empty((len(source), 0), np.int64) if block.arrival is None else block.arrival,
    )


def streams_of(
    name: str,
    description: Description,
    truth: str,
    followed: Followed,
    failures: Mapping[int, Failure],
) -> list[Ragged]:
    """Make output streams from the results of filters."""
    topic, (issued_ns, estimates, offsets, innovations, recorded) = f"/estimates/{name}", followed
    state = state_stream(
        f"{topic}/{description.output}",
        estimates.time_ns,
        description.state,
        truth,
        estimates.mean,
        estimates.covariance,
    )
    state = replace(state, log_time_ns=issued_ns)
    made = [Ragged(state, offsets), failures_by_run(topic, failures, len(offsets) - 1)]
    if description.innovation:
        made.append(recorded_innovations(topic, description.innovation, truth, innovations, recorded))
        check_stream(made[-1].stream)
    return made


def of_run(parts: Sequence[FilterEvents], run: int) -> FilterEvents:
    """Join one run's events of several blocks."""
    spans = [slice(int(each.offsets[run]), int(each.offsets[run + 1])) for each in parts]
    columns = [
        np.concatenate([each[place][span] for each, span in zip(parts, spans, strict=True)])
        for place in range(1, len(FilterEvents._fields))
    ]
    return FilterEvents(np.array([0, len(columns[0])]), *columns)


def joined(of_runs: Sequence[Followed]) -> Followed:
    """Join the results of single runs."""
    estimates = zip(*(run.estimates for run in of_runs), strict=True)
    innovations = zip(*(run.innovations for run in of_runs), strict=True)
    return Followed(
        np.concatenate([run.issued_ns for run in of_runs]),
        EstimateRows(*map(np.concatenate, estimates)),
        _offsets([len(run.estimates.time_ns) for run in of_runs]),
        InnovationRows(*map(np.concatenate, innovations)),
        _offsets([len(run.innovations.time_ns) for run in of_runs]),
    )


def _offsets(counts: Sequence[int]) -> Integers:
    return np.cumsum([0, *counts])
