"""Streams of many runs, concatenated in ragged columns, and their events merged in time order."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import compress
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.log import Clock, Stream
from fuselog.replay.engine.arrays import AnyArray, Columns, RowSlice
from fuselog.replay.engine.streams.failures import join_streams

Found = TypeVar("Found")


class Findings(dict[Hashable, Columns]):
    """Cache of values computed from columns that never change; it keeps the most recent entries."""

    def __init__(self, most: int = 16) -> None:
        super().__init__()
        self._most = most

    def once(self, key: Hashable, find: Callable[[], Found]) -> Found:
        """Return the cached value of `key`; if there is none, call `find` and cache its result."""
        try:
            known: Found = self[key]
            return known
        except KeyError:
            while len(self) >= self._most:  # before the new value takes memory
                self.pop(list(self)[0], None)  # noqa: RUF015 other threads may add entries
        kept: Found = self.setdefault(key, find())
        return kept

    def __reduce__(self) -> tuple[type["Findings"], tuple[int]]:
        return Findings, (self._most,)  # another process computes the values again


@dataclass(frozen=True)
class Ragged:
    """One topic of several runs; rows offsets[r]:offsets[r + 1] of the stream belong to run r.

    Attributes:
        stream: the rows of all runs, end to end.
        offsets: (runs + 1,), first row of each run, and the end of the last run.
    """

    stream: Stream
    offsets: NDArray[np.int64]

    @cached_property
    def findings(self) -> Findings:
        """Return the cache of values that depend only on these messages, such as priors."""
        return Findings()

    def __getitem__(self, name: str) -> AnyArray:
        """Return the column of the field `name`, all runs end to end."""
        return self.stream.columns[name]

    def __len__(self) -> int:
        return len(self.stream)

    @property
    def runs(self) -> int:
        """Return the number of runs, including empty ones."""
        return len(self.offsets) - 1

    def of_run(self, run: int) -> Stream:
        """Return the rows of the run numbered `run`, without a copy."""
        return self.stream.take(slice(int(self.offsets[run]), int(self.offsets[run + 1])))


class Events(NamedTuple):
    """Messages of several topics in time order; events offsets[r]:offsets[r + 1] belong to run r.

    Event e is a message of the topic with index `topic[e]`; `source[e]` is its index among the messages
    of all topics, end to end. `is_last[e]` is true if no later event of the run has the same stamp;
    estimates are made only at these events.
    """

    offsets: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    topic: NDArray[np.int64]
    source: NDArray[np.int64]
    is_last: NDArray[np.bool_]


CarriedType = TypeVar("CarriedType", bound=tuple[Columns, ...])


class Block(NamedTuple):
    """Input of an estimator for one call: a span of its topics, in all runs.

    Attributes:
        streams: by topic.
        events: the messages of all topics in order of processing.
        arrival: (n, 2), for every event, the time at which it is processed and its position in the file,
            if the events are not simply in the order of their stamps; see
            `fuselog.replay.engine.replaying.late`.
        findings: cache of values computed from the block if it will be replayed again, otherwise None.
    """

    streams: dict[str, Ragged]
    events: Events
    arrival: NDArray[np.int64] | None = None
    findings: Findings | None = None

    def once(self, key: Hashable, find: Callable[[], Found]) -> Found:
        """Return the cached value of `key`; if there is none, compute it with `find`."""
        return find() if self.findings is None else self.findings.once(key, find)

    def column(self, *names: str, missing: float = np.nan) -> AnyArray:
        """Return a column over all events, from the first of `names` that a topic has, or `missing`."""
        parts = []
        for ragged in self.streams.values():
            found = [name for name in names if name in ragged.stream.columns]
            parts.append(ragged[found[0]] if found else np.full(len(ragged), missing))
        return np.concatenate(parts)[self.events.source]


def copied(carried: CarriedType) -> CarriedType:
    """Copy a NamedTuple of arrays, which may contain other such NamedTuples."""
    columns: Columns = carried
    made: type[CarriedType] = type(carried)
    return made(*[copied(each) if isinstance(each, tuple) else each.copy() for each in columns])


def of_runs(carried: CarriedType, runs: RowSlice) -> CarriedType:
    """View the part of a NamedTuple of arrays (runs, ...) that belongs to some runs.

    Args:
        carried: a NamedTuple of arrays (runs, ...), or of such NamedTuples.
        runs: slice of the runs.
    """
    columns: Columns = carried
    made: type[CarriedType] = type(carried)
    return made(
        *(of_runs(column, runs) if isinstance(column, tuple) else column[runs] for column in columns)
    )


def ragged_rows(chosen: NDArray[np.bool_], offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Compute the offsets of the chosen rows of ragged columns.

    Args:
        chosen: (n,) whether a row is chosen.
        offsets: (runs + 1,) offsets of all rows.
    """
    if np.count_nonzero(chosen) == len(chosen):
        return offsets
    return np.searchsorted(np.flatnonzero(chosen), offsets)


def run_of_rows(offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the run of every row (n,) of ragged columns, given their offsets (runs + 1,)."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


def by_runs(parts: Sequence[NDArray[np.int64]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Compute an order that puts the rows of each run together, from several parts.

    Args:
        parts: offsets (runs + 1,) of each part.

    Returns:
        The order (n,) of the rows, and their offsets.
    """
    run = np.concatenate([run_of_rows(each) for each in parts])
    return np.argsort(run, kind="stable"), sum(parts, np.zeros(1, np.int64))


def filled_rows(
    offsets: NDArray[np.int64], end: NDArray[np.int64]
) -> tuple["NDArray[np.int64] | RowSlice", NDArray[np.int64]]:
    """Find the filled rows of ragged columns.

    Args:
        offsets: (runs + 1,), first row of each run.
        end: (runs,), end of the filled rows of each run.

    Returns:
        The filled rows (n,), or a slice if all rows are filled, and their offsets (runs + 1,).
    """
    if end.tobytes() == offsets[1:].tobytes():
        return slice(None), offsets
    run = run_of_rows(offsets)
    filled = np.arange(len(run)) < end[run]
    return np.flatnonzero(filled), ragged_rows(filled, offsets)


def is_in_order(runs: Ragged, order: Clock) -> bool:
    """Test whether every run's messages are sorted by a clock and by their positions in the file.

    Args:
        runs: the messages of a topic, in all runs.
        order: the clock.
    """
    clock, position = runs.stream.times(order), runs.stream.position
    ordered = (clock[1:] >= clock[:-1]) & (position[1:] > position[:-1])
    if ordered.all():
        return True
    begins = runs.offsets[1:-1]  # where another run begins, or the rows end
    ordered[begins[(begins > 0) & (begins < len(clock))] - 1] = True
    return bool(ordered.all())


def gather(parts: Sequence[Stream]) -> Ragged:
    """Concatenate the runs' streams of one topic."""
    counts = [len(part) for part in parts]
    offsets = np.zeros(len(parts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    filled = parts if all(counts) else [*compress(parts, counts)] or parts[:1]
    return Ragged(join_streams(filled), offsets)


def join(parts: Sequence[Ragged]) -> Ragged:
    """Join blocks of one topic, with the rows of each run together."""
    if len(parts) == 1:
        return parts[0]
    order, offsets = by_runs([part.offsets for part in parts])
    stream = join_streams([part.stream for part in parts if len(part)] or [parts[0].stream])
    return Ragged(stream if len(offsets) == 2 else stream.take(order), offsets)


def side_by_side(parts: Sequence[Ragged]) -> Ragged:
    """Concatenate the first runs of all parts, then all second runs, and so on."""
    counts = np.stack([np.diff(part.offsets) for part in parts], axis=1)
    places = np.arange(counts.size).reshape(counts.shape)
    run = np.concatenate([np.repeat(*of_part) for of_part in zip(places.T, counts.T, strict=True)])
    stream = join_streams([part.stream for part in parts if len(part)] or [parts[0].stream])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return Ragged(stream.take(np.argsort(run, kind="stable")), offsets)


def merge_events(streams: Mapping[str, Ragged], order: Clock) -> Events:
    """Merge topics in time order, run by run; messages with equal stamps keep the order of the file.

    Args:
        streams: messages of all runs, by topic.
        order: the clock.
    """
    everything = list(streams.values())
    if len(everything) == 1:
        return _in_order(everything[0], order)
    times_ns = np.concatenate([ragged.stream.times(order) for ragged in everything])
    positions = np.concatenate([ragged.stream.position for ragged in everything])
    starts = np.cumsum([0, *(len(ragged) for ragged in everything[:-1])])
    bounds = np.stack([ragged.offsets for ragged in everything]) + starts[:, None]
    offsets = sum((ragged.offsets for ragged in everything), np.zeros(1, np.int64))
    count = len(times_ns)
    topic, source, time_ns = (np.empty(count, np.int64) for _ in range(3))
    events = Events(offsets, time_ns, topic, source, np.empty(count, bool))
    heads = partial(np.empty, len(everything), np.int64)
    _merge(len(offsets) - 1, bounds, times_ns, positions, events, scratch=heads)
    return events


def _in_order(ragged: Ragged, order: Clock) -> Events:
    """Make the events of a single topic."""
    times_ns, offsets, count = ragged.stream.times(order), ragged.offsets, len(ragged)
    is_last = last_of_equals(offsets, times_ns)
    return Events(offsets, times_ns, np.zeros(count, np.int64), np.arange(count), is_last)


def last_of_equals(offsets: NDArray[np.int64], *columns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Test whether each row (n,) is the last of its run, or differs from the next row in some column.

    Args:
        offsets: (runs + 1,), first row of each run.
        columns: (n,) each.
    """
    is_last = np.zeros(len(columns[0]), bool)
    for column in columns:
        is_last[:-1] |= column[1:] != column[:-1]
    is_last[offsets[1:][offsets[1:] > offsets[:-1]] - 1] = True
    return is_last


def merge_run(
    run: int,
    bounds: NDArray[np.int64],
    times_ns: NDArray[np.int64],
    positions: NDArray[np.int64],
    events: Events,
    heads: NDArray[np.int64],
) -> None:
    """Merge a run's sorted topics in time order; messages with equal stamps keep the file's order.

    Args:
        run: number of the run.
        bounds: (topics, runs + 1), first message of each topic in each run, and the end of the last run.
        times_ns, positions: (n,) stamps of the messages of all topics, end to end, and their positions
            in the file.
        events: events of all runs; those of run `run` are filled.
        heads: (topics,), work space.
    """
    for k in range(len(heads)):
        heads[k] = bounds[k, run]
    for event in range(events.offsets[run], events.offsets[run + 1]):
        first = -1
        for k in range(len(heads)):
            if heads[k] < bounds[k, run + 1]:
                if first < 0:
                    first = k
                later_ns = times_ns[heads[k]] - times_ns[heads[first]]
                if later_ns < 0 or (later_ns == 0 and positions[heads[k]] < positions[heads[first]]):
                    first = k
        time_ns = times_ns[heads[first]]
        if event > events.offsets[run] and time_ns == events.time_ns[event - 1]:
            events.is_last[event - 1] = False
        events.time_ns[event], events.is_last[event] = time_ns, True
        events.topic[event], events.source[event] = first, heads[first]
        heads[first] += 1


_merge = compile_over_runs(merge_run)
