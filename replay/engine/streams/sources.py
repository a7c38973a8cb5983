"""Reads the runs of a replay: from log files, or from recordings in memory; one run or many."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import zip_longest
from typing import Protocol, Self, TypeVar

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
from recorders.log.impossible import YEAR_NS, main_span, possible
from recorders.recording import Recording
from replay.engine.streams.blocks import Block, Findings, Ragged, gather, is_in_order, merge_events


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
        """Return topics in blocks that follow one another in time; see `recorders.log.read_blocks`."""

    def whole(self) -> "Source":
        """Return the run without a span."""

    @property
    def rejections(self) -> "Rejections":
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


class Rejections(dict[str, Counter[str]]):
    """Counts messages that are left out, being impossible: by topic, and by what is wrong."""

    def note(self, topic: str, found: Counter[str]) -> None:
        """Note what a read of a topic, whole or in part, left out; it may be read again."""
        self[topic] = self.get(topic, Counter()) | found

    def sentence(self, topic: str) -> str:
        """Say what is left out of a topic."""
        return "; ".join(
            f"{count} {'message is' if count == 1 else 'messages are'} left out: {why}"
            for why, count in self[topic].items()
        )


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
        """Return what times in s count from: the log's epoch, without one the first of `clock`."""
        return self.log.run.epoch_ns if self.log.run else read_span(self.log, clock)[0]

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
        first_ns, last_ns = self.extent("publish_time")
        topics = [topic for topic in self.topics if is_sensed(self, topic)]
        if last_ns - first_ns < YEAR_NS or not topics:
            return None
        blocks = read_blocks(self.log, topics)
        return main_span(each.publish_time_ns for block in blocks for each in block.values())

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


SourceType = TypeVar("SourceType", bound=Source)
# Of a block of few messages it is kept what a few filters make of it: of more that takes much memory.
FEW_MESSAGES, FEW_FILTERS = 1 << 13, 4


class Ensemble(list[SourceType]):
    """Represents runs that are replayed together: they hold the same topics.

    An ensemble is replayed many times, so topics that are in memory are laid end to end once and kept,
    with what was found of them (`findings`); no run may be added to it or taken from it.
    """

    def __init__(self, sources: Iterable[SourceType]) -> None:
        super().__init__(sources)
        self.findings = Findings()
        self._kept: dict[tuple[str, Clock], Ragged] = {}
        self._alike: set[str] = set()

    def __reduce__(self) -> tuple[type["Ensemble[SourceType]"], tuple[list[SourceType]]]:
        return type(self), (list(self),)

    @cached_property
    def starts_ns(self) -> dict[int, int]:
        """Find where the replayed spans begin, by run; of those that do not begin with their run."""
        starts_ns = ((run, source.start_ns) for run, source in enumerate(self))
        return {run: start_ns for run, start_ns in starts_ns if start_ns is not None}

    def require_alike(self, topics: Iterable[str]) -> None:
        """Raise BadInput where a run does not hold these topics as the first one does."""
        first = self[0]
        for topic in topics:
            if topic in self._alike:
                continue
            here = first.topics[topic]
            stated = here.schema_name, here.metadata
            for source in self:
                there = source.topics.get(topic)
                if there is None or (there.schema_name, there.metadata) != stated:
                    raise BadInput(
                        f"{source.name}: topic {topic} differs from that of {first.name}; the runs of "
                        "an ensemble have the same topics and types, so replay this one on its own"
                    )
            self._alike.add(topic)

    def read(self, topics: Sequence[str]) -> dict[str, Ragged]:
        """Return whole topics, in publish-time order."""
        if self._recordings:
            return self._laid_out(topics, "publish_time")
        runs = [source.read(topics) for source in self]
        return {topic: gather([run[topic] for run in runs]) for topic in topics}

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Ragged]]:
        """Return the next block of every run, until all runs are at their end.

        The runs need not be at the same time: each has its own state. Recordings are one block.
        """
        if not topics:
            return
        if self._are_whole:
            block = self._laid_out(topics, order)
            if any(len(ragged) for ragged in block.values()):
                yield block
            return
        empty = {topic: self[0].empty(topic) for topic in topics}
        ended: dict[str, Stream] = {}
        runs = [source.blocks(topics, order, block_messages) for source in self]
        for blocks in zip_longest(*runs, fillvalue=ended):
            yield {
                topic: gather([block.get(topic, nothing) for block in blocks])
                for topic, nothing in empty.items()
            }

    def block(self, streams: dict[str, Ragged], order: Clock) -> Block:
        """Return messages with their order in time; of whole recordings as they were found before."""

        def merged(findings: Findings | None = None) -> Block:
            return Block(streams, merge_events(streams, order), findings=findings)

        if any(self._kept.get((topic, order)) is not ragged for topic, ragged in streams.items()):
            return merged()
        if sum(map(len, streams.values())) > FEW_MESSAGES:
            return merged()
        return self.findings.once(("block", order, *streams), lambda: merged(Findings(FEW_FILTERS)))

    @cached_property
    def _recordings(self) -> list[MemorySource]:
        """Return the runs, where all are in memory."""
        found: list[MemorySource] = [each for each in self if isinstance(each, MemorySource)]
        return found if len(found) == len(self) else []

    @property
    def is_in_memory(self) -> bool:
        """Tell whether all runs are recordings."""
        return bool(self._recordings)

    @cached_property
    def _are_whole(self) -> bool:
        """Tell whether all runs are in memory, without spans."""
        return bool(self._recordings) and all(run.is_whole for run in self._recordings)

    def _laid_out(self, topics: Sequence[str], order: Clock) -> dict[str, Ragged]:
        """Return topics of recordings, each run by one of the clocks."""
        for topic in topics:
            if (topic, order) not in self._kept:
                together = gather([source.stream_of(topic) for source in self._recordings])
                if not is_in_order(together, order):
                    together = gather([source.in_order(topic, order) for source in self._recordings])
                self._kept[topic, order] = together
        return {topic: self._kept[topic, order] for topic in topics}


def ensemble_of(sources: Sequence[SourceType]) -> Ensemble[SourceType]:
    """Return the ensemble of these runs, which may be one already."""
    return sources if isinstance(sources, Ensemble) else Ensemble(sources)
