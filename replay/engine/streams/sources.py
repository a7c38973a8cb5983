"""Sources of a replay: runs in log files, or recordings in memory."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

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
from fuselog.replay.engine.streams.blocks import Ragged, is_in_order


class Source(Protocol):
    """One run, as replay and evaluation use it."""

    @property
    def name(self) -> str:
        """Return the name that messages use for the run."""

    @property
    def run(self) -> RunMetadata | None:
        """Return the metadata of the run."""

    @property
    def epoch_ns(self) -> int:
        """Return the run's time zero."""

    @property
    def start_ns(self) -> int | None:
        """Return the start of the replayed span by the replay's clock, or None for the run's start."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Return the topics of the run."""

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Read whole topics in publish-time order."""

    def empty(self, topic: str) -> Stream:
        """Return `topic` without its messages."""

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield topics in blocks, one after another; see `fuselog.recorders.log.read_blocks`."""

    def whole(self) -> "Source":
        """Return the whole run, without a span."""

    @property
    def rejections(self) -> Rejections:
        """Return the impossible messages that were left out of everything read so far."""


@dataclass(frozen=True)
class DerivedSource:
    """Base of sources that read another source `of`, with its name, time zero, span and rejections."""

    of: Source

    @property
    def name(self) -> str:
        """Return the name of the other source."""
        return self.of.name

    @property
    def epoch_ns(self) -> int:
        """Return the time zero of its run."""
        return self.of.epoch_ns

    @property
    def start_ns(self) -> int | None:
        """Return the start of its span."""
        return self.of.start_ns

    @property
    def rejections(self) -> Rejections:
        """Return the impossible messages left out of everything read from the other source so far."""
        return self.of.rejections


def is_sensed(source: Source, topic: str) -> bool:
    """Test whether `topic` of `source` is recorded sensor data in columns, not estimates or images."""
    if topic.startswith("/estimates/"):
        return False
    try:
        source.empty(topic)
    except BadInput:
        return False
    return True


@dataclass(frozen=True, repr=False)
class _Readable(Mapping[str, Stream]):
    """Mapping from topics to whole streams; other names raise `UnknownName`.

    Attributes:
        rejections: impossible messages that were left out of everything read so far.
        is_raw: whether impossible messages are kept.
    """

    rejections: Rejections = field(default_factory=Rejections, kw_only=True, compare=False)
    is_raw: bool = field(default=False, kw_only=True)

    def as_written(self) -> Self:
        """Return the source with all of its messages, including impossible ones."""
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
    """Log file, or a span of one, that is read lazily; a mapping from topics to streams.

    Attributes:
        log: the opened file.
        start_ns, end_ns: start (included) and end (excluded) of the span; None for the run's own start
            or end.
    """

    log: Log
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def name(self) -> str:
        """Return the path of the log."""
        return str(self.log.path)

    @property
    def run(self) -> RunMetadata | None:
        """Return the run metadata of the log."""
        return self.log.run

    @cached_property
    def epoch_ns(self) -> int:
        """Return the run's time zero or, if the log does not state one, its first publish stamp."""
        return self.zero_ns("publish_time")

    def zero_ns(self, clock: Clock) -> int:
        """Return the zero of times in s: the log's epoch or, without one, the first stamp of `clock`.

        A first stamp that is years away from most others is ignored.
        """
        if self.log.run:
            return self.log.run.epoch_ns
        return (self.main_span or self.extent(clock))[0]

    def extent(self, clock: Clock) -> tuple[int, int]:
        """Return the first and last stamp in ns by `clock`, or zeros if there are no messages."""
        return read_span(self.log, clock)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Return the topics of the log."""
        return self.log.topics

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Read all of `topics` in publish-time order, regardless of the span."""
        return self._possible(read_streams(self.log, topics), Rejections())

    def empty(self, topic: str) -> Stream:
        """Return `topic` without its messages."""
        return read_empty(self.log, topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield the span of `topics`, by the clock `order`, at most `block_messages` at a time."""
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
        """Remove impossible messages, except from estimates, and add them to the counts in `before`."""
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
        """Return the span of most messages if others are years away from it; otherwise return None."""
        topics = [topic for topic in self.topics if is_sensed(self, topic)]
        if not topics:
            return None
        return main_span_of(self.extent("publish_time"), lambda: read_blocks(self.log, topics))

    def whole(self) -> "LogSource":
        """Return the whole log."""
        return replace(self, start_ns=None, end_ns=None)


@dataclass(frozen=True, repr=False)
class MemorySource(_Readable):
    """Recording in memory, read and replayed like a log file with the same streams.

    Attributes:
        streams: by topic.
        run: metadata of the recording.
        name: name in messages.
        start_ns, end_ns: start (included) and end (excluded) of the span; None for the run's own start
            or end.
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
        """Return the zero of times in s: the epoch, for any `clock`."""
        return self.epoch_ns

    def extent(self, clock: Clock) -> tuple[int, int]:
        """Return the first and last stamp in ns by `clock`, or zeros if there are no messages."""
        times = [stream.times(clock) for stream in self.streams.values() if len(stream)]
        first_ns = min((int(each.min()) for each in times), default=0)
        return first_ns, max((int(each.max()) for each in times), default=0)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Return the topics of the recording."""
        return {
            topic: Topic(topic, stream.schema.full_name, "protobuf", (), stream.metadata, len(stream))
            for topic, stream in self.streams.items()
        }

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Read all of `topics` in publish-time order."""
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
        """Yield the span of `topics` by the clock `order` as one block; ignore `block_messages`."""
        spans = {topic: self._within(self.in_order(topic, order), order) for topic in topics}
        block = {topic: stream for topic, stream in spans.items() if len(stream)}
        if block:
            yield block

    def whole(self) -> "MemorySource":
        """Return the whole recording."""
        return self if self.is_whole else replace(self, start_ns=None, end_ns=None)

    @property
    def is_whole(self) -> bool:
        """Test whether the source has no span."""
        return self.start_ns is None and self.end_ns is None

    def _within(self, stream: Stream, order: Clock) -> Stream:
        """Return the messages of an ordered stream that are in the source's span."""
        if self.is_whole:
            return stream
        times_ns = stream.times(order)
        start = 0 if self.start_ns is None else np.searchsorted(times_ns, self.start_ns)
        end = len(stream) if self.end_ns is None else np.searchsorted(times_ns, self.end_ns)
        return stream.take(slice(int(start), int(end)))

    def in_order(self, topic: str, order: Clock) -> Stream:
        """Return `topic` in order of the clock `order`; equal times keep the order of the file."""
        stream = self.stream_of(topic)
        if is_in_order(Ragged(stream, np.array([0, len(stream)])), order):
            return stream
        return stream.take(np.lexsort((stream.position, stream.times(order))))

    def stream_of(self, topic: str) -> Stream:
        """Return `topic` as it was recorded, without impossible messages.

        Raises BadInput if there is no such topic.
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
        """Return the span of most messages if others are years away from it; otherwise return None."""
        return main_span(each.publish_time_ns for each in self.streams.values())


def memory_source(recording: Recording, run: RunMetadata) -> MemorySource:
    """Make a source of a recording, with its messages sorted by log time as in a file (a stable sort).

    Args:
        recording: streams in memory.
        run: metadata of the run.
    """
    streams = recording.streams
    ranks = np.empty(sum(map(len, streams)), np.int64)
    times = [stream.log_time_ns for stream in streams]
    ranks[np.argsort(np.concatenate(times), kind="stable")] = np.arange(len(ranks))
    cuts = accumulate(map(len, streams), initial=0)
    placed = {
        stream.topic: _at(ranks[first:end], stream)
        for stream, (first, end) in zip(streams, pairwise(cuts), strict=True)
    }
    return MemorySource(placed, run, f"run {run.run} of {run.scenario}")


def _at(position: NDArray[np.int64], of: Stream) -> Stream:
    stamps_ns = of.publish_time_ns, of.log_time_ns
    return Stream(of.topic, of.schema, *stamps_ns, of.columns, position, of.metadata)


def in_memory(source: LogSource | MemorySource, topics: Iterable[str] | None = None) -> MemorySource:
    """Read a log's topics into memory, by default all recorded ones; return a recording as it is."""
    if isinstance(source, MemorySource):
        return source
    if topics is None:
        topics = [topic for topic in source.topics if is_sensed(source, topic)]
    return MemorySource(
        source.read(list(topics)),
        source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns),
        source.name,
        source.start_ns,
        source.end_ns,
        rejections=source.rejections,
    )
