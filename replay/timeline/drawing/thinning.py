"""Thins a long run for its timeline: whole while it is short, then evenly in time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Clock, Field, RunMetadata, Stream, Topic, schemas
from fuselog.recorders.log.impossible import Rejections
from fuselog.replay.engine.streams.failures import join_streams
from fuselog.replay.engine.streams.sources import Source, is_sensed
from fuselog.replay.judging.errors.evaluation import PER_ROW, Errors, Floats, errors_at
from fuselog.replay.timeline.drawing.canvas import DRAWN_ROWS, extremes

Times = NDArray[np.int64]
# So many messages of a topic are kept; what is drawn of them is less, see `canvas.DRAWN_ROWS`.
KEPT_ROWS = 50_000
# An error has a covariance with it, and is drawn as a curve alone.
KEPT_ERRORS = 20_000
# Of these, a message says nothing without the others.
WHOLE = frozenset(
    schema.full_name
    for schema in (
        schemas.IDENTITY,
        schemas.SCORE_VECTOR,
        schemas.TRACK_ESTIMATE,
        schemas.ESTIMATE_SIZE,
        schemas.SET_ESTIMATE,
        schemas.DENSITY_ESTIMATE,
        schemas.FAILURE,
        schemas.OUTAGE,
    )
)
# A vector of more entries is no bundle of curves.
WIDE = 12
BLOCK_MESSAGES = 1 << 17
# A cell of 2^62 ns is all time.
LAST_SHIFT = 62
Rows = TypeVar("Rows", Stream, Errors)


class Thinned(Generic[Rows]):
    """Keeps rows of a stream as they come, about `limit` after a while and at most twice as many.

    Time is cut into cells of a power of two of nanoseconds. Of each, what is kept are the rows of the
    last stamp, and of those where one of the curves has its least and its greatest value there, so that
    peaks stay. Cells lie in wider cells, so the blocks that the rows came in do not matter for that.
    """

    def __init__(
        self,
        limit: int | None,
        time_ns: Callable[[Rows], Times],
        curves: Callable[[Rows], list[Floats]],
        take: Callable[[Rows, NDArray[np.bool_]], Rows],
        join: Callable[[Sequence[Rows]], Rows],
    ) -> None:
        self._limit = limit
        self._time_ns: Callable[[Rows], Times] = time_ns
        self._curves: Callable[[Rows], list[Floats]] = curves
        self._take: Callable[[Rows, NDArray[np.bool_]], Rows] = take
        self._join: Callable[[Sequence[Rows]], Rows] = join
        self._parts: list[Rows] = []
        self._count = 0
        self._shift = 0

    def add(self, rows: Rows) -> None:
        """Take in the next rows, sorted by time."""
        if self._shift:
            rows = self._take(rows, self._stays(rows) | self._is_first(rows))
        count = len(self._time_ns(rows))
        if count == 0 and self._parts:
            return
        if self._count == 0:  # vectors of nothing have no width
            self._parts = []
        self._parts.append(rows)
        self._count += count
        if self._limit is not None and self._count > 2 * self._limit:
            self._coarsen(2 * self._limit)

    @property
    def rows(self) -> Rows:
        """Return what is kept."""
        if len(self._parts) > 1:
            self._thin()
        return self._parts[0]

    @property
    def is_whole(self) -> bool:
        """Tell whether all rows are kept so far."""
        return self._shift == 0

    def _coarsen(self, most: int) -> None:
        """Widen the cells until so many rows are left at most."""
        self._thin()
        while self._count > most and self._shift < LAST_SHIFT:
            self._shift += 1
            cells = self._time_ns(self._parts[0]) >> self._shift
            if np.count_nonzero(np.diff(cells)) < most:  # of each cell a row is left at least
                self._thin()

    def _thin(self) -> None:
        """Join the parts, some of which may share a cell."""
        rows = self._parts[0] if len(self._parts) == 1 else self._join(self._parts)
        if self._shift:
            rows = self._take(rows, self._stays(rows))
        self._parts, self._count = [rows], len(self._time_ns(rows))

    def _stays(self, rows: Rows) -> NDArray[np.bool_]:
        """Tell which rows are kept of their cells; of the widest, all time, the last stamp's are."""
        time_ns = self._time_ns(rows)
        cell = time_ns >> self._shift
        kept = [np.flatnonzero(np.append(cell[1:] != cell[:-1], True)[: len(cell)])]
        if self._shift < LAST_SHIFT:
            kept += [extremes(cell, values) for values in self._curves(rows)]
        stamp = np.cumsum(np.diff(time_ns, prepend=time_ns[:1]) > 0)
        stays = np.zeros(len(time_ns), bool)
        stays[stamp[np.concatenate(kept)]] = True
        return stays[stamp]

    def _is_first(self, rows: Rows) -> NDArray[np.bool_]:
        """Tell which rows have the first stamp: others of it may have come in the block before."""
        time_ns = self._time_ns(rows)
        return time_ns == time_ns[:1]


def thinned_stream(schema_name: str, limit: int) -> Thinned[Stream]:
    """Thin the messages of a topic; of some schemas, they are all kept."""
    return Thinned(
        None if schema_name in WHOLE else limit,
        lambda stream: stream.publish_time_ns,
        lambda stream: [values for _, of_field in curves_of(stream) for values in of_field],
        lambda stream, rows: stream.take(rows),
        join_streams,
    )


def thinned_errors(limit: int) -> Thinned[Errors]:
    """Thin the errors of one run."""
    return Thinned(
        limit,
        lambda errors: errors.time_ns,
        lambda errors: list(errors.error.T),
        errors_at,
        _joined_errors,
    )


def curves_of(stream: Stream) -> Iterator[tuple[Field, Floats]]:
    """Yield the fields that are curves over time, as (curves, n): no covariances, nothing wide."""
    for entry in stream.schema:
        if entry.kind in ("real", "vector") and not entry.name.startswith("covariance"):
            values = stream[entry.name].reshape(len(stream), -1 if len(stream) else 0).T
            if len(values) <= WIDE:
                yield entry, values


def _joined_errors(parts: Sequence[Errors]) -> Errors:
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_ROW
    }
    count = sum(part.without_truth for part in parts)
    return replace(parts[-1], without_truth=count, heading_rad=None, **joined)


class Thin:
    """Thins the outputs of a run and the errors of its estimates; keeps the last stamp of an output."""

    def __init__(self, rows: int, errors: int) -> None:
        self._rows, self._errors_rows = rows, errors
        self._outputs: dict[str, Thinned[Stream]] = {}
        self._errors: dict[tuple[str, str], Thinned[Errors]] = {}
        self.added = 0
        self.last_ns = -1

    def add(self, outputs: Mapping[str, Stream], errors: Sequence[Errors]) -> None:
        """Take in a block."""
        for topic, stream in outputs.items():
            if topic not in self._outputs:
                self._outputs[topic] = thinned_stream(stream.schema.full_name, self._rows)
            self._outputs[topic].add(stream)
            self.added += len(stream)
            if len(stream):
                self.last_ns = max(self.last_ns, int(stream.publish_time_ns[-1]))
        for each in errors:
            what = each.estimator, each.case
            if what not in self._errors:
                self._errors[what] = thinned_errors(self._errors_rows)
            self._errors[what].add(each)

    @property
    def outputs(self) -> dict[str, Stream]:
        """Return what is kept, by topic."""
        return {topic: kept.rows for topic, kept in self._outputs.items()}

    @property
    def whole(self) -> dict[str, Stream]:
        """Return the outputs of which all is kept."""
        return {topic: kept.rows for topic, kept in self._outputs.items() if kept.is_whole}

    @property
    def errors(self) -> list[Errors]:
        """Return what is kept of the errors."""
        return [kept.rows for kept in self._errors.values()]


@dataclass(frozen=True)
class Held:
    """Represents a source of which some topics are held in memory already, thinned or in part."""

    of: Source
    streams: Mapping[str, Stream]

    @property
    def name(self) -> str:
        """Return the source's."""
        return self.of.name

    @property
    def run(self) -> RunMetadata | None:
        """Return the source's."""
        return self.of.run

    @property
    def epoch_ns(self) -> int:
        """Return the source's."""
        return self.of.epoch_ns

    @property
    def start_ns(self) -> int | None:
        """Return the source's."""
        return self.of.start_ns

    @property
    def rejections(self) -> Rejections:
        """Return the source's."""
        return self.of.rejections

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Return the source's, held or not."""
        return self.of.topics

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Return what is held of the topics; of others, all."""
        others = self.of.read([topic for topic in topics if topic not in self.streams])
        return {
            topic: self.streams[topic] if topic in self.streams else others[topic] for topic in topics
        }

    def empty(self, topic: str) -> Stream:
        """Return the topic without its messages."""
        return self.of.empty(topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield all there is, not only what is held."""
        return self.of.blocks(topics, order, block_messages)

    def whole(self) -> "Held":
        """Return itself."""
        return self


class Sensed:
    """Reads the sensor streams and truths of a source along with a replay of it.

    Maps, and what is said but once, such as where a sensor is mounted, hold for every span of the run.
    """

    def __init__(self, source: Source, *, is_live: bool) -> None:
        self.source = source
        self._is_live = is_live
        sensed = [topic for topic in source.topics if is_sensed(source, topic)]
        self._lasting = source.read([topic for topic in sensed if self._is_lasting(topic)])
        self._topics = [topic for topic in sensed if topic not in self._lasting]
        self._kept, self._fresh = self._empty(KEPT_ROWS), self._empty(DRAWN_ROWS)
        self._blocks = self.source.blocks(self._topics, "publish_time", BLOCK_MESSAGES)
        self._read_to_ns = -1

    def _empty(self, rows: int) -> dict[str, Thinned[Stream]]:
        streams = [self.source.empty(topic) for topic in self._topics]
        kept = {each.topic: thinned_stream(each.schema.full_name, rows) for each in streams}
        for each in streams:
            kept[each.topic].add(each)
        return kept

    def read_to(self, time_ns: int) -> Held:
        """Read what comes up to a stamp, and has not come yet, thinned to what is drawn."""
        self.advance(time_ns)
        streams = {topic: fresh.rows for topic, fresh in self._fresh.items()}
        self._fresh = self._empty(DRAWN_ROWS)
        return Held(self.source, {**self._lasting, **streams})

    def advance(self, time_ns: int) -> None:
        """Read on up to a stamp."""
        while self._read_to_ns < time_ns and (block := next(self._blocks, None)) is not None:
            for topic, stream in block.items():
                self._kept[topic].add(stream)
                if self._is_live:
                    self._fresh[topic].add(stream)
                self._read_to_ns = max(self._read_to_ns, int(stream.publish_time_ns[-1]))

    def _is_lasting(self, topic: str) -> bool:
        stated = self.source.topics[topic]
        return stated.schema_name == schemas.LANDMARK.full_name or stated.messages == 1

    def all(self) -> Held:
        """Return all of it, thinned."""
        self.advance(np.iinfo(np.int64).max)
        kept = {topic: kept.rows for topic, kept in self._kept.items()}
        return Held(self.source, {**self._lasting, **kept})
