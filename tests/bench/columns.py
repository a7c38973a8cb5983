"""Columns of many runs end to end, as hand-written references take them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.streams.sources import MemorySource

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def column(sources: list[MemorySource], topic: str, field: str) -> NDArray:
    """A field of all runs end to end."""
    return np.ascontiguousarray(np.concatenate([source.streams[topic][field] for source in sources]))


def stamps_ns(sources: list[MemorySource], topic: str) -> Integers:
    """The stamps of all runs end to end."""
    return np.concatenate([source.streams[topic].publish_time_ns for source in sources])


def offsets_of(counts: list[int]) -> Integers:
    """Where runs of so many rows begin and end."""
    return np.concatenate([[0], np.cumsum(counts)])


def offsets(sources: list[MemorySource], topic: str) -> Integers:
    """Where the runs' messages begin and end."""
    return offsets_of([len(source.streams[topic]) for source in sources])


def prior(sources: list[MemorySource], topic: str, size: int) -> tuple[Floats, Floats]:
    """Means (runs, n) and covariances (runs, n, n)."""
    return column(sources, topic, "mean"), column(sources, topic, "covariance").reshape(-1, size, size)


def copied(state: Any) -> Any:
    """A NamedTuple of arrays that a kernel may work in."""
    return type(state)(*(part.copy() for part in state))
