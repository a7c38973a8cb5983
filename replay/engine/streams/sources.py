"""Reads the runs of a replay: from log files, or from recordings in memory; one run or many."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np

from fuselog.recorders.errors import BadInput, UnknownName, choices
from fuselog.recorders.log import (
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
from fuselog.recorders.log.impossible import Rejections, main_span, main_span_of, possible
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import gather, is_in_order


class Source(Protocol):
    """Represents one run, as replay and evaluation see it."""

    @property
    def name(self) -> str:
        """Return what to call the run in a message."""

    @property
    def run(self) -> RunMetadata | None:
        """Return what the run was."""

    @property
    def epoch_ns(self) -> int:
        """Return the run's time zero."""

    @property
    def start_ns(self) -> int | None:
        """Find where the replayed span begins, by the clock of the replay; None where the run begins."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Return what it holds."""

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Return whole topics, in publish-time order."""

    def empty(self, topic: str) -> Stream:
        """Return `topic` without its messages."""

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Return topics in blocks, one after another; see `fuselog.recorders.log.read_blocks`."""

    def whole(self) -> "Source":
        """Return the run without a span."""

    @property
    def rejections(self) -> Rejections:
        """Return what was left out of all that was read, being impossible."""


def is_sensed(source: Source, topic: str) -> bool:
    """Tell whether `topic` of the run `source` is its own, and columns: no estimates, no images."""
    if topic.startswith("/estimates/"):
        return False
    try:
        source.empty(topic)
    except BadInput:
        return False
    return True


@dataclass(frozen=True, repr=False)
class _Readable(Mapping[str, Stream]):
    """Maps topics to whole streams, as a person reads a source; raises `UnknownName` for others.

    Attributes:
        rejections: what was left out of all that was read, being impossible.
        is_raw: whether nothing is left out.
    """

    rejections: Rejections = field(default_factory=Rejections, kw_only=True, compare=False)
    is_raw: bool = field(default=False, kw_only=True)

    def as_written(self) -> Self:
        """Return the source with all of its messages, impossible ones as well."""
        return replace(self, is_raw=True)

    def __getitem__(self: Source, topic: str) -> Stream:
        if topic not in self.topics:
            raise UnknownName(f"{self.name}: no topic {topic}; {choices(topic, self.topics)}")
        assert isinstance(self, _Readable)
        return self.as_written().read([topic])[topic]

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
    """Represents a log file, or a span of it, read lazily; it maps its topics to their streams.

    Attributes:
        log: the opened file.
        start_ns, end_ns: the span, its end left out; None where it does not begin or end.
    """

    log: Log
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def name(self) -> str:
        """Compute the log's path."""
        return str(self.log.path)

    @property
    def run(self) -> RunMetadata | None:
        """Compute the log's run metadata."""
        return self.log.run

    @cached_property
    def epoch_ns(self) -> int:
        """Return the run's time zero; where the log does not say, its first publish stamp."""
        return self.zero_ns("publish_time")

    def zero_ns(self, clock: Clock) -> int:
        """Return what times in s count from: the log's epoch, without one the first of `clock`.

        A first stamp that is years from those of most messages does not count.
        """
        if self.log.run:
            return self.log.run.epoch_ns
        return (self.main_span or self.extent(clock))[0]

    def extent(self, clock: Clock) -> tuple[int, int]:
        """Find the first and the last stamp in ns by `clock`; zeros where there are none."""
        return read_span(self.log, clock)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Compute the log's topics."""
        return self.log.topics

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Return all of `topics` in publish-time order, whatever the source's span."""
        return self._possible(read_streams(self.log, topics), Rejections())

    def empty(self, topic: str) -> Stream:
        """Return `topic` without its messages."""
        return read_empty(self.log, topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield the span of `topics` by the clock `order`, up to `block_messages` in a block."""
        before = Rejections()
        for block in read_blocks(
            self.log,
            topics,
            order=order,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            block_messages=block_messages,
        ):
            kept = self._possible(block, before)
            yield {topic: stream for topic, stream in kept.items() if len(stream)}

    def _possible(self, streams: Mapping[str, Stream], before: Rejections) -> dict[str, Stream]:
        """Leave out impossible messages, and note them with those `before` these; not of estimates."""
        kept = dict(streams)
        for topic, stream in streams.items() if not self.is_raw else ():
            if topic.startswith("/estimates/"):
                continue
            kept[topic], found = possible(stream, self.main_span)
            if found:
                before[topic] = before.get(topic, Counter()) + found
                self.rejections.note(topic, before[topic])
        return kept

    @cached_property
    def main_span(self) -> tuple[int, int] | None:
        """Find the first and last stamp of most messages if others are years from them."""
        topics = [topic for topic in self.topics if is_sensed(self, topic)]
        if not topics:
            return None
        return main_span_of(self.extent("publish_time"), lambda: read_blocks(self.log, topics))

    def whole(self) -> "LogSource":
        """Return the whole log."""
        return replace(self, start_ns=None, end_ns=None)


@dataclass(frozen=True, repr=False)
class MemorySource(_Readable):
    """Represents a recording in memory: read and replayed as if it had been written and read back.

    Attributes:
        streams: by topic.
        run: how it was recorded.
        name: what messages call it.
        start_ns, end_ns: the span, its end left out; None where it does not begin or end.
    """

    streams: Mapping[str, Stream]
    run: RunMetadata
    name: str
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def epoch_ns(self) -> int:
        """Return the run's time zero."""
        return self.run.epoch_ns

    def zero_ns(self, clock: Clock) -> int:  # noqa: ARG002
        """Return what times in seconds count from: the epoch, whatever the `clock`."""
        return self.epoch_ns

    def extent(self, clock: Clock) -> tuple[int, int]:
        """Return the first and the last stamp in ns by `clock`; zeros where there are none."""
        times = [stream.times(clock) for stream in self.streams.values() if len(stream)]
        first_ns = min((int(each.min()) for each in times), default=0)
        return first_ns, max((int(each.max()) for each in times), default=0)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Return the recording's topics."""
        return {
            topic: Topic(topic, stream.schema.full_name, "protobuf", (), stream.metadata, len(stream))
            for topic, stream in self.streams.items()
        }

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Return all of `topics` in publish-time order."""
        return {topic: self.in_order(topic, "publish_time") for topic in topics}

    def empty(self, topic: str) -> Stream:
        """Return `topic` without its messages."""
        return self.streams[topic].take(slice(0, 0))

    def blocks(
        self,
        topics: Sequence[str],
        order: Clock,
        block_messages: int,  # noqa: ARG002
    ) -> Iterator[dict[str, Stream]]:
        """Yield the span of `topics` by `order` in one block, whatever `block_messages` asks for."""
        spans = {topic: self._within(self.in_order(topic, order), order) for topic in topics}
        block = {topic: stream for topic, stream in spans.items() if len(stream)}
        if block:
            yield block

    def whole(self) -> "MemorySource":
        """Return the whole recording."""
        return replace(self, start_ns=None, end_ns=None)

    @property
    def is_whole(self) -> bool:
        """Tell whether there is no span."""
        return self.start_ns is None and self.end_ns is None

    def _within(self, stream: Stream, order: Clock) -> Stream:
        """Return the messages of the source's span, of a stream in order."""
        if self.is_whole:
            return stream
        times_ns = stream.times(order)
        start = 0 if self.start_ns is None else np.searchsorted(times_ns, self.start_ns)
        end = len(stream) if self.end_ns is None else np.searchsorted(times_ns, self.end_ns)
        return stream.take(slice(int(start), int(end)))

    def in_order(self, topic: str, order: Clock) -> Stream:
        """Return `topic` by the clock `order`; equal stamps as in the file."""
        stream = self.stream_of(topic)
        if is_in_order(gather([stream]), order):
            return stream
        return stream.take(np.lexsort((stream.position, stream.times(order))))

    def stream_of(self, topic: str) -> Stream:
        """Return `topic` as it was recorded; raises BadInput where it is not there.

        Impossible messages are left out.
        """
        if topic not in self.streams:
            raise BadInput(f"{self.name}: no topic {topic}; it has {', '.join(sorted(self.streams))}")
        if self.is_raw:
            return self.streams[topic]
        stream, found = possible(self.streams[topic], self.main_span)
        if found:
            self.rejections.note(topic, found)
        return stream

    @cached_property
    def main_span(self) -> tuple[int, int] | None:
        """Find the first and last stamp of most messages if others are years from them."""
        return main_span(each.publish_time_ns for each in self.streams.values())


def memory_source(recording: Recording, run: RunMetadata) -> MemorySource:
    """Make a source of a recording with a log's positions: merged by log time, ties in order.

    Args:
        recording: streams in memory.
        run: what is known of it.
    """
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
