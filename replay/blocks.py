"""Ragged columns: the streams of many runs laid end to end, and their merged order of events."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream
from recorders.log.reader import Order
from recorders.log.streams import concatenate


@dataclass(frozen=True)
class Ragged:
    """One topic of several runs: run r owns the rows offsets[r]:offsets[r + 1] of the stream."""

    stream: Stream
    offsets: NDArray[np.int64]

    def __getitem__(self, name: str) -> NDArray:
        """The column of one field, all runs end to end."""
        return self.stream.columns[name]

    def __len__(self) -> int:
        return len(self.stream)

    @property
    def runs(self) -> int:
        """How many runs there are, empty ones included."""
        return len(self.offsets) - 1

    def of_run(self, run: int) -> Stream:
        """The rows of one run, without a copy."""
        return self.stream.take(slice(int(self.offsets[run]), int(self.offsets[run + 1])))


class Events(NamedTuple):
    """The messages of several topics in time order: run r owns offsets[r]:offsets[r + 1].

    Event e is row `row[e]` of the topic with index `topic[e]`. `is_last[e]` says that no later event of
    the run has its stamp: the moment for an estimate.
    """

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    topic: NDArray[np.int64]
    row: NDArray[np.int64]
    is_last: NDArray[np.bool_]


class Block(NamedTuple):
    """What an estimator gets at once: a span of its topics, in all runs."""

    streams: dict[str, Ragged]
    events: Events


def gather(parts: Sequence[Stream]) -> Ragged:
    """Lay the runs' streams of one topic end to end."""
    offsets = np.zeros(len(parts) + 1, np.int64)
    np.cumsum([len(part) for part in parts], out=offsets[1:])
    filled = [part for part in parts if len(part)] or list(parts[:1])
    return Ragged(concatenate(filled), offsets)


def merge_events(streams: Mapping[str, Ragged], order: Order) -> Events:
    """All messages of the topics in time order, run by run; equal stamps keep the order of the file."""
    offsets = sum((ragged.offsets for ragged in streams.values()), np.zeros(1, np.int64))
    runs = len(offsets) - 1
    pieces = [
        np.stack(
            [
                np.repeat(np.arange(runs), np.diff(ragged.offsets)),
                ragged.stream.publish_time_ns if order == "publish_time" else ragged.stream.log_time_ns,
                ragged.stream.position,
                np.full(len(ragged), index),
                np.arange(len(ragged)),
            ]
        )
        for index, ragged in enumerate(streams.values())
    ]
    run, time_ns, position, topic, row = np.concatenate(pieces, axis=1)
    merged = np.lexsort((position, time_ns, run))
    time_ns, run = time_ns[merged], run[merged]
    is_last = np.ones(len(merged), bool)
    is_last[:-1] = (time_ns[1:] != time_ns[:-1]) | (run[1:] != run[:-1])
    return Events(offsets, time_ns, topic[merged], row[merged], is_last)
