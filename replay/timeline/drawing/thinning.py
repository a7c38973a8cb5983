"""Thinning of long runs for timelines: short runs are complete, longer ones evenly sampled."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Clock, Field, RunMetadata, Stream, Topic, schemas
from fuselog.replay.engine.streams.failures import join_streams
from fuselog.replay.engine.streams.sources import DerivedSource, Source, is_sensed
from fuselog.replay.judging.errors.evaluation import MAY_BE_NONE, PER_ROW, Errors, Floats, errors_at
from fuselog.replay.timeline.drawing.canvas import DRAWN_ROWS
from fuselog.replay.timeline.drawing.extremes import extremes

Times = NDArray[np.int64]
# Number of messages kept of a topic; fewer are drawn, see `canvas.DRAWN_ROWS`.
KEPT_ROWS = 50_000
# The same for errors, which have covariances and are only drawn as curves.
KEPT_ERRORS = 20_000
# Schemas for which all messages are kept, because they are meaningless without the others.
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
# A vector with more entries is not drawn as curves.
WIDE = 12
BLOCK_MESSAGES = 1 << 17
# A cell of 2^62 ns contains all times.
LAST_SHIFT = 62
Rows = TypeVar("Rows", Stream, Errors)


class Thinned(Generic[Rows]):
    """Rows of a stream, thinned on arrival to about `limit` rows and at most twice as many.

    Time is divided into cells whose length in nanoseconds is a power of two. Each cell keeps the rows of
    its last stamp and the rows at which a curve has its minimum or maximum, which preserves peaks. Cells
    are nested in wider cells, so the result does not depend on the division into blocks.
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
        """Add the next rows, sorted by time."""
        if self._shift:
            rows = self._take(rows, self._stays(rows) | self._is_first(rows))
        count = len(self._time_ns(rows))
        if count == 0 and self._parts:
            return
        if self._count == 0:  # vectors without messages have no width
            self._parts = []
        self._parts.append(rows)
        self._count += count
        if self._limit is not None and self._count > 2 * self._limit:
            self._coarsen(2 * self._limit)

    @property
    def rows(self) -> Rows:
        """Return the kept rows."""
        if len(self._parts) > 1:
            self._thin()
        return self._parts[0]

    @property
    def is_whole(self) -> bool:
        """Test whether all rows have been kept so far."""
        return self._shift == 0

    def _coarsen(self, most: int) -> None:
        """Widen the cells until at most this number of rows remains."""
        self._thin()
        while self._count > most and self._shift < LAST_SHIFT:
            self._shift += 1
            cells = self._time_ns(self._parts[0]) >> self._shift
            if np.count_nonzero(np.diff(cells)) < most:  # at least one row per cell is kept
                self._thin()

    def _thin(self) -> None:
        """Join the parts, some of which may share a cell."""
        rows = self._parts[0] if len(self._parts) == 1 else self._join(self._parts)
        if self._shift:
            rows = self._take(rows, self._stays(rows))
        self._parts, self._count = [rows], len(self._time_ns(rows))

    def _stays(self, rows: Rows) -> NDArray[np.bool_]:
        """Find the rows to keep in each cell; cells of the largest width keep only their last stamp."""
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
        """Find the rows of the first stamp, which may also be in the previous block."""
        time_ns = self._time_ns(rows)
        return time_ns == time_ns[:1]


def thinned_stream(schema_name: str, limit: int) -> Thinned[Stream]:
    """Make a thinned stream for the messages of a topic; some schemas are kept completely."""
    return Thinned(
        None if schema_name in WHOLE else limit,
        lambda stream: stream.publish_time_ns,
        lambda stream: [values for _, of_field in curves_of(stream) for values in of_field],
        lambda stream, rows: stream.take(rows),
        join_streams,
    )


def thinned_errors(limit: int) -> Thinned[Errors]:
    """Make a thinned series for the errors of one run."""
    return Thinned(
        limit,
        lambda errors: errors.time_ns,
        lambda errors: list(errors.error.T),
        errors_at,
        _joined_errors,
    )


def curves_of(stream: Stream) -> Iterator[tuple[Field, Floats]]:
    """Yield the fields that are curves over time (curves, n), without covariances and long vectors."""
    for entry in stream.schema:
        if entry.kind in ("real", "vector") and not entry.name.startswith("covariance"):
            values = stream[entry.name].reshape(len(stream), -1 if len(stream) else 0).T
            if len(values) <= WIDE:
                yield entry, values


def _joined_errors(parts: Sequence[Errors]) -> Errors:
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_ROW
    } | dict.fromkeys(MAY_BE_NONE)
    count = sum(part.without_truth for part in parts)
    return replace(parts[-1], without_truth=count, **joined)


class Thin:
    """Thinned outputs of a run and errors of its estimates, with the last stamp of each output."""

    def __init__(self, rows: int, errors: int) -> None:
        self._rows, self._errors_rows = rows, errors
        self._outputs: dict[str, Thinned[Stream]] = {}
        self._errors: dict[tuple[str, str], Thinned[Errors]] = {}
        self.added = 0
        self.last_ns = -1

    def add(self, outputs: Mapping[str, Stream], errors: Sequence[Errors]) -> None:
        """Add a block."""
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
        """Return the kept outputs by topic."""
        return {topic: kept.rows for topic, kept in self._outputs.items()}

    @property
    def whole(self) -> dict[str, Stream]:
        """Return the outputs that are kept completely."""
        return {topic: kept.rows for topic, kept in self._outputs.items() if kept.is_whole}

    @property
    def errors(self) -> list[Errors]:
        """Return the kept errors."""
        return [kept.rows for kept in self._errors.values()]


@dataclass(frozen=True)
class Held(DerivedSource):
    """Source of which some topics are already in memory, thinned or incomplete."""

    streams: Mapping[str, Stream]

    @property
    def run(self) -> RunMetadata | None:
        """Return the run metadata of the source."""
        return self.of.run

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Return all topics of the source, including those that are not in memory."""
        return self.of.topics

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Return the messages of topics in memory, and read other topics completely."""
        others = self.of.read([topic for topic in topics if topic not in self.streams])
        return {
            topic: self.streams[topic] if topic in self.streams else others[topic] for topic in topics
        }

    def empty(self, topic: str) -> Stream:
        """Return the stream of a topic without its messages."""
        return self.of.empty(topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield blocks of all messages of the source, not only of those in memory."""
        return self.of.blocks(topics, order, block_messages)

    def whole(self) -> "Held":
        """Return this source itself."""
        return self


class Sensed:
    """Sensor streams and truths of a source, read along with a replay of it.

    Maps and topics with a single message, such as the mounting of a sensor, apply to every span of the
    run.
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
        """Read new messages up to a stamp and return them thinned for drawing."""
        self.advance(time_ns)
        streams = {topic: fresh.rows for topic, fresh in self._fresh.items()}
        self._fresh = self._empty(DRAWN_ROWS)
        return Held(self.source, {**self._lasting, **streams})

    def advance(self, time_ns: int) -> None:
        """Read further messages up to a stamp."""
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
        """Read to the end and return everything, thinned."""
        self.advance(np.iinfo(np.int64).max)
        kept = {topic: kept.rows for topic, kept in self._kept.items()}
        return Held(self.source, {**self._lasting, **kept})
