"""Where a replay reads from: a log file, or a recording that is still in memory."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from recorders.errors import BadInput, UnknownName, choices
from recorders.log import (
    Clock,
    Log,
    RunMetadata,
    Stream,
    Topic,
    read_blocks,
    read_empty,
    read_span,
    read_streams,
)
from recorders.recording import Recording


class Source(Protocol):
    """One run, as replay and evaluation see it."""

    @property
    def name(self) -> str:
        """What to call the run in a message."""

    @property
    def run(self) -> RunMetadata | None:
        """What the run was."""

    @property
    def epoch_ns(self) -> int:
        """The run's time zero."""

    @property
    def start_ns(self) -> int | None:
        """Where the replayed span begins, by the clock of the replay; None where the run begins."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """What it holds."""

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Whole topics, in publish-time order."""

    def empty(self, topic: str) -> Stream:
        """The topic without its messages."""

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Topics in blocks that follow one another in time; see `recorders.log.read_blocks`."""

    def whole(self) -> "Source":
        """The run without a span."""


class _Readable(Mapping[str, Stream]):
    """A source as a person reads it: whole streams by topic.

    A topic that is not there raises `UnknownName`.
    """

    def __getitem__(self: Source, topic: str) -> Stream:
        if topic not in self.topics:
            raise UnknownName(f"{self.name}: no topic {topic}; {choices(topic, self.topics)}")
        return self.read([topic])[topic]

    def __contains__(self: Source, topic: object) -> bool:
        return topic in self.topics

    def __iter__(self: Source) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self: Source) -> int:
        return len(self.topics)

    def __repr__(self: Source) -> str:
        run = self.run
        of = f": {run.scenario}, seed {run.seed}, run {run.run}" if run else ""
        width = max(map(len, self.topics), default=0)
        rows = [
            f"  {name:{width}} {topic.messages:9} {topic.schema_name}"
            for name, topic in self.topics.items()
        ]
        return "\n".join([self.name + of, *rows])


@dataclass(frozen=True, repr=False)
class LogSource(_Readable):
    """A log file, read lazily; it maps its topics to their streams."""

    log: Log
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def name(self) -> str:
        """The log's path."""
        return str(self.log.path)

    @property
    def run(self) -> RunMetadata | None:
        """The log's run metadata."""
        return self.log.run

    @cached_property
    def epoch_ns(self) -> int:
        """The run's time zero; where the log does not say, its first publish stamp."""
        return self.zero_ns("publish_time")

    def zero_ns(self, clock: Clock) -> int:
        """What times in seconds count from, by one of the two clocks.

        It is the epoch that the log states; without one the first stamp of that clock, for the two may
        have nothing in common (simulated and wall time, say).
        """
        return self.log.run.epoch_ns if self.log.run else read_span(self.log, clock)[0]

    def extent(self, clock: Clock) -> tuple[int, int]:
        """The first and the last stamp in ns by one of the two clocks."""
        return read_span(self.log, clock)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The log's topics."""
        return self.log.topics

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Whole topics, in publish-time order, whatever the source's span."""
        return read_streams(self.log, topics)

    def empty(self, topic: str) -> Stream:
        """The topic without its messages."""
        return read_empty(self.log, topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Blocks of the source's span."""
        return read_blocks(
            self.log,
            topics,
            order=order,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            block_messages=block_messages,
        )

    def whole(self) -> "LogSource":
        """The whole log."""
        return LogSource(self.log)


@dataclass(frozen=True, repr=False)
class MemorySource(_Readable):
    """A recording in memory: read and replayed as if it had been written and read back."""

    streams: Mapping[str, Stream]
    run: RunMetadata
    name: str
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def epoch_ns(self) -> int:
        """The run's time zero."""
        return self.run.epoch_ns

    def zero_ns(self, clock: Clock) -> int:  # noqa: ARG002
        """What times in seconds count from: the epoch, by either clock."""
        return self.epoch_ns

    def extent(self, clock: Clock) -> tuple[int, int]:
        """The first and the last stamp in ns by one of the two clocks; zeros where there are none."""
        times = [stream.times(clock) for stream in self.streams.values() if len(stream)]
        first_ns = min((int(each.min()) for each in times), default=0)
        return first_ns, max((int(each.max()) for each in times), default=0)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """The recording's topics."""
        return {
            topic: Topic(topic, stream.schema.full_name, "protobuf", (), stream.metadata, len(stream))
            for topic, stream in self.streams.items()
        }

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Whole topics, in publish-time order."""
        missing = [topic for topic in topics if topic not in self.streams]
        if missing:
            raise BadInput(
                f"{self.name}: no topic {missing[0]}; it has {', '.join(sorted(self.streams))}"
            )
        return {topic: self._in_order(topic, "publish_time") for topic in topics}

    def empty(self, topic: str) -> Stream:
        """The topic without its messages."""
        return self.streams[topic].take(slice(0, 0))

    def blocks(
        self,
        topics: Sequence[str],
        order: Clock,
        block_messages: int,  # noqa: ARG002
    ) -> Iterator[dict[str, Stream]]:
        """The source's span in one block, unless there is nothing: everything is in memory already."""
        spans = {topic: self._within(self._in_order(topic, order), order) for topic in topics}
        block = {topic: stream for topic, stream in spans.items() if len(stream)}
        if block:
            yield block

    def whole(self) -> "MemorySource":
        """The whole recording."""
        return replace(self, start_ns=None, end_ns=None)

    def _within(self, stream: Stream, order: Clock) -> Stream:
        """The messages of the source's span, of a stream in order."""
        if self.start_ns is None and self.end_ns is None:
            return stream
        times_ns = stream.times(order)
        start = 0 if self.start_ns is None else np.searchsorted(times_ns, self.start_ns)
        end = len(stream) if self.end_ns is None else np.searchsorted(times_ns, self.end_ns)
        return stream.take(slice(int(start), int(end)))

    def _in_order(self, topic: str, order: Clock) -> Stream:
        if (topic, order) not in self._ordered:
            self._ordered[topic, order] = self._sorted(topic, order)
        return self._ordered[topic, order]

    @cached_property
    def _ordered(self) -> dict[tuple[str, Clock], Stream]:
        """What was sorted once; an ensemble is replayed several times."""
        return {}

    def _sorted(self, topic: str, order: Clock) -> Stream:
        stream = self.streams[topic]
        clock = stream.publish_time_ns if order == "publish_time" else stream.log_time_ns
        position = stream.position
        if np.all(clock[1:] >= clock[:-1]) and np.all(position[1:] > position[:-1]):
            return stream
        return stream.take(np.lexsort((position, clock)))


def memory_source(recording: Recording, run: RunMetadata) -> MemorySource:
    """A recording with the positions that a log of it would have: merged by log time, ties in order."""
    streams = recording.streams
    ranks = np.empty(sum(map(len, streams)), np.int64)
    times = [stream.log_time_ns for stream in streams]
    ranks[np.argsort(np.concatenate(times), kind="stable")] = np.arange(len(ranks))
    cuts = np.cumsum([len(stream) for stream in streams])[:-1]
    placed = [
        replace(stream, position=rank)
        for stream, rank in zip(streams, np.split(ranks, cuts), strict=True)
    ]
    return MemorySource(
        {stream.topic: stream for stream in placed}, run, f"run {run.run} of {run.scenario}"
    )
