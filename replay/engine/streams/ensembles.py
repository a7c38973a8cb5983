"""Ensembles of runs that are replayed together; their streams are concatenated by topic and cached."""

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import zip_longest
from typing import TypeVar

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream
from fuselog.recorders.log.impossible import possible
from fuselog.replay.engine.streams.blocks import (
    Block,
    Findings,
    Ragged,
    gather,
    is_in_order,
    merge_events,
)
from fuselog.replay.engine.streams.sources import MemorySource, Source

SourceType = TypeVar("SourceType", bound=Source)
# Only small blocks cache the findings of a few filters; larger blocks would need too much memory.
FEW_MESSAGES, FEW_FILTERS = 1 << 13, 4
# Larger blocks are merged for each estimator, since their memory is needed for the next one.
MANY_MESSAGES = 1 << 20


class Ensemble(list[SourceType]):
    """List of runs that are replayed together and have the same topics.

    An ensemble is replayed many times, so topics that are in memory are concatenated once and cached,
    together with values computed from them (`findings`), and with the estimators that were bound to it
    first (`bound`), of which others may differ only in numbers. Runs must not be added or removed.
    """

    def __init__(self, sources: Iterable[SourceType]) -> None:
        super().__init__(sources)
        self.findings = Findings()
        self.bound = Findings()
        self._kept: dict[tuple[str, Clock], Ragged] = {}
        self._alike: set[str] = set()

    def __reduce__(self) -> tuple[type["Ensemble[SourceType]"], tuple[list[SourceType]]]:
        return type(self), (list(self),)

    @cached_property
    def starts_ns(self) -> dict[int, int]:
        """Return the start of the replayed span for each run that is not replayed from its own start."""
        starts_ns = ((run, source.start_ns) for run, source in enumerate(self))
        return {run: start_ns for run, start_ns in starts_ns if start_ns is not None}

    def require_alike(self, topics: Iterable[str]) -> None:
        """Raise BadInput if a run differs from the first in the schema or metadata of these topics."""
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
                        "an ensemble must have the same topics and types, so replay this run separately"
                    )
            self._alike.add(topic)

    def read(self, topics: Sequence[str]) -> dict[str, Ragged]:
        """Read whole topics in publish-time order."""
        if self._recordings:
            return self._laid_out(topics, "publish_time")
        runs = [source.read(topics) for source in self]
        return {topic: gather([run[topic] for run in runs]) for topic in topics}

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Ragged]]:
        """Yield the next block of every run, until all runs have ended.

        The blocks of different runs need not cover the same time, because each run has its own state. A
        recording in memory is a single block.
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

    def block(self, streams: dict[str, Ragged], order: Clock, latest: Findings) -> Block:
        """Merge messages in time order; the order of short whole recordings is cached.

        Args:
            streams: by topic.
            order: the clock.
            latest: cache of the last merged block, which estimators of the same topics share in a
                replay.
        """

        def merged(findings: Findings | None = None) -> Block:
            return Block(streams, merge_events(streams, order), findings=findings)

        messages = sum(map(len, streams.values()))
        kept = (self._kept.get((topic, order)) is ragged for topic, ragged in streams.items())
        if messages > MANY_MESSAGES:
            return merged()
        if messages > FEW_MESSAGES or not all(kept):
            same = tuple((topic, id(ragged)) for topic, ragged in streams.items())
            return latest.once(same, lambda: merged(Findings(1)))
        return self.findings.once(("block", order, *streams), lambda: merged(Findings(FEW_FILTERS)))

    @cached_property
    def _recordings(self) -> list[MemorySource]:
        """Return the runs if all are in memory, otherwise an empty list."""
        found: list[MemorySource] = [each for each in self if isinstance(each, MemorySource)]
        return found if len(found) == len(self) else []

    @property
    def is_in_memory(self) -> bool:
        """Test whether all runs are recordings in memory."""
        return bool(self._recordings)

    @cached_property
    def _are_whole(self) -> bool:
        """Test whether all runs are in memory and are replayed as a whole."""
        return bool(self._recordings) and all(run.is_whole for run in self._recordings)

    def _laid_out(self, topics: Sequence[str], order: Clock) -> dict[str, Ragged]:
        """Return topics of recordings, with each run sorted by a clock."""
        for topic in topics:
            if (topic, order) not in self._kept:
                together = self._together(topic)
                if not is_in_order(together, order):
                    together = gather([source.in_order(topic, order) for source in self._recordings])
                self._kept[topic, order] = together
        return {topic: self._kept[topic, order] for topic in topics}

    def _together(self, topic: str) -> Ragged:
        """Concatenate a topic of recordings as recorded, without impossible messages."""
        if all(topic in source.streams and source.main_span is None for source in self._recordings):
            together = gather([source.streams[topic] for source in self._recordings])
            if not possible(together.stream, None)[1]:  # faster than to test each run
                return together
        return gather([source.stream_of(topic) for source in self._recordings])


def ensemble_of(sources: Sequence[SourceType]) -> Ensemble[SourceType]:
    """Return the ensemble of these runs; `sources` may already be one."""
    return sources if isinstance(sources, Ensemble) else Ensemble(sources)
