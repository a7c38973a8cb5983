"""History of the latest messages of every run, with the belief after each message."""

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Columns, Floats, Integers
from fuselog.replay.inference.kalman.update import innovation_components
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.run.events import data_columns
from fuselog.replay.inference.run.recursion import (
    NOTHING,
    FilterEvents,
    RecursionState,
)

BEFORE_ALL_NS = np.iinfo(np.int64).min
Structure = tuple[tuple[str, "int | Structure"], ...]


class KeptMessages(NamedTuple):
    """Messages in order, each with the belief after it; the first axis is the message, run by run.

    Attributes:
        time_ns, source, data, target_id: see `recursion.FilterEvents`; `target_id` is stored as uint32.
        position: position in the file.
        after: state after the message.
        has_innovation: whether the message was an update and therefore has an innovation.
        difference, covariance, numbers: see `steps.InnovationRecord`.
    """

    time_ns: Integers
    source: Integers
    data: Floats
    target_id: Columns
    position: Integers
    after: RecursionState
    has_innovation: Booleans
    difference: Floats
    covariance: Floats
    numbers: Floats


class History(NamedTuple):
    """The latest messages of every run.

    Attributes:
        start_ns: (runs,) stamps of the priors.
        first, counts: (runs,) rows of each run: run r has C rows of `kept`; `counts[r]` of them are
            filled, starting at row r C + first[r]. The messages after the first filled row can be
        reprocessed from the state stored in it.
        kept: (runs C) the messages.
    """

    start_ns: Integers
    first: Integers
    counts: Integers
    kept: KeptMessages

    @property
    def capacity(self) -> int:
        """Number of rows for every run."""
        return len(self.kept.time_ns) // max(len(self.first), 1)

    @property
    def rows(self) -> Integers:
        """Filled rows, run by run."""
        begin = np.arange(len(self.first)) * self.capacity + self.first
        before = np.cumsum(self.counts) - self.counts
        return np.repeat(begin - before, self.counts) + np.arange(self.counts.sum())

    @property
    def offsets(self) -> Integers:
        """Offsets of the runs: run r has the entries offsets[r]:offsets[r + 1] of `rows`."""
        return np.append(0, np.cumsum(self.counts))

    def with_room(self, capacity: int) -> "History":
        """Copy the history to `capacity` rows per run; the filled rows come first."""
        rows, runs = self.rows, np.arange(len(self.first))
        places = np.repeat(runs * capacity - self.offsets[:-1], self.counts) + np.arange(len(rows))

        def moved(column: Columns) -> Columns:
            if isinstance(column, tuple):
                made = type(column)
                return made(*map(moved, column))
            wider = np.zeros((len(runs) * capacity, *column.shape[1:]), column.dtype)
            wider[places] = column[rows]
            return wider

        return self._replace(
            first=np.zeros_like(self.first), counts=self.counts.copy(), kept=moved(self.kept)
        )


def no_history(bound_model: BoundModel, carried: RecursionState) -> History:
    """Make a history that contains only the priors.

    Args:
        bound_model: the bound model, with the sensors of the log.
        carried: state at the priors.
    """
    runs, innovation_size, (width, _) = (
        len(carried.time_ns),
        len(innovation_components(bound_model.sensors)),
        data_columns(bound_model),
    )
    kept = KeptMessages(
        np.full(runs, BEFORE_ALL_NS),
        np.full(runs, NOTHING),
        np.zeros((runs, width)),
        np.zeros(runs, np.uint32),
        np.full(runs, -1),
        carried,
        np.zeros(runs, bool),
        *(
            np.zeros((runs, *shape))
            for shape in ((innovation_size,), (innovation_size, innovation_size), (3,))
        ),
    )
    return History(carried.time_ns, np.zeros(runs, np.int64), np.ones(runs, np.int64), kept)


def most_within(history: History, events: FilterEvents, window_ns: int) -> int:
    """Return the largest number of messages, stored and new, of any run within a window.

    Args:
        history: history of all runs.
        events: the new messages.
        window_ns: length of the window.
    """
    most, kept_ns, kept = 0, history.kept.time_ns[history.rows], history.offsets
    for run, (begin, end) in enumerate(zip(events.offsets[:-1], events.offsets[1:], strict=True)):
        before_ns = kept_ns[kept[run] + 1 : kept[run + 1]]
        time_ns = np.sort(np.concatenate([before_ns, events.time_ns[begin:end]]))
        through = np.searchsorted(time_ns, time_ns + window_ns, side="right")
        most = max(most, int((through - np.arange(len(time_ns))).max(initial=0)))
    return most


def structure_of(rows: Columns) -> Structure:
    """Describe a NamedTuple of arrays, possibly nested, by its names and numbers of axes."""
    return tuple(
        (name, structure_of(column) if isinstance(column, tuple) else column.ndim)
        for name, column in zip(rows._fields, rows, strict=True)
    )


class CopyRow(Protocol):
    """Function that copies row i of a NamedTuple of arrays to row j of another."""

    def __call__(self, source: Columns, i: int, target: Columns, j: int, /) -> None: ...


@lru_cache(maxsize=64)
def copying_rows(structure: Structure) -> CopyRow:
    """Make `copy(source, i, target, j)`, which copies a row of a NamedTuple of arrays to another."""
    columns = tuple(name for name, of in structure if not isinstance(of, tuple))
    groups = tuple((name, copying_rows(of)) for name, of in structure if isinstance(of, tuple))

    def copy(source: Columns, i: int, target: Columns, j: int) -> None:
        for name in columns:
            getattr(target, name)[j] = getattr(source, name)[i]
        for name, copy_group in groups:
            copy_group(getattr(source, name), i, getattr(target, name), j)

    return copy
