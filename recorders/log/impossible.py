"""Detection of values that no sensor can produce: infinite, or beyond the limit of their unit."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log.schemas import BODY_POINT, LANDMARK
from fuselog.recorders.log.streams import Stream
from fuselog.recorders.units import unit_of

# By the unit at the end of a name: far beyond what is measured, even as wrongly scaled integers.
LIMITS = {
    "m": 1e12,
    "m/s": 1e10,
    "m/s^2": 1e12,
    "rad": 1e6,
    "rad/s": 1e6,
    "deg": 1e12,
    "s": 1e12,
    "uT": 1e12,
}
# For all others, such as covariances and scores: their squares do not overflow.
LIMIT = 1e50
LEAST = min(LIMITS.values())
# A gap between stamps that does not occur within a log.
YEAR_NS = 31_556_952 * 10**9
# Messages that are sent once, at any stamp.
TIMELESS = {LANDMARK.full_name, BODY_POINT.full_name}


class Impossible(NamedTuple):
    """Impossible values of one component of a field.

    Attributes:
        field, name: the field, and its component in words.
        rows: (n,), messages with such values.
        value: the largest of these values.
        limit: the largest possible value.
    """

    field: str
    name: str
    rows: NDArray[np.bool_]
    value: float
    limit: float

    @property
    def words(self) -> str:
        """Describe what is wrong with the component."""
        if np.isinf(self.value):
            return f"{self.name} is infinite"
        return f"{self.name} is {self.value:.3g}, but can be at most {self.limit:.0e}"


def impossible(stream: Stream) -> Iterator[Impossible]:
    """Yield the components of a stream's fields that have impossible values."""
    for entry in stream.schema:
        column = stream.columns.get(entry.name)
        if column is None or column.dtype.kind != "f" or not column.size:
            continue
        low, high = float(column.min()), float(column.max())
        if low >= -LEAST and high <= LEAST:  # two fast passes; False if there is NaN
            continue
        names = _components(stream, entry.name)
        limits = [limit_of(name) for name in names]
        if -min(limits) <= low and high <= min(limits):
            continue
        by_component = column.reshape(len(column), -1).T
        for component, limit, values in zip(names, limits, by_component, strict=True):
            rows = np.abs(values) > limit
            if rows.any():
                value = values[np.argmax(np.where(rows, np.abs(values), 0.0))]
                name = " ".join(dict.fromkeys([entry.name, component]))
                yield Impossible(entry.name, name, rows, float(value), limit)


def possible(stream: Stream, span_ns: tuple[int, int] | None) -> tuple[Stream, Counter[str]]:
    """Remove impossible messages, and count each once, by reason.

    Args:
        stream: the messages.
        span_ns: the span outside which a stamp is impossible (see `main_span`); None allows all stamps.
    """
    found: Counter[str] = Counter()
    wrong = [(each.words, each.rows) for each in impossible(stream)]
    if span_ns is not None and stream.schema.full_name not in TIMELESS:
        outside = (stream.publish_time_ns < span_ns[0]) | (stream.publish_time_ns > span_ns[1])
        wrong.append(("the stamp is years away from those of most messages", outside))
    kept = np.ones(len(stream) if wrong else 0, bool)
    for words, rows in wrong:
        found[words] += int(np.count_nonzero(rows & kept))
        kept &= ~rows
    found = +found
    return (stream.take(kept), found) if found else (stream, found)


def main_span(stamps_ns: Iterable[NDArray[np.int64]]) -> tuple[int, int] | None:
    """Find the first and last stamp of most messages; None unless other messages are years away.

    Args:
        stamps_ns: several arrays (n,) in any order.
    """
    parts = [each for each in stamps_ns if len(each)]
    ends_ns = [int(end) for each in parts for end in (each.min(), each.max())]
    if not parts or max(ends_ns) - min(ends_ns) <= YEAR_NS:
        return None
    together = np.sort(np.concatenate(parts))
    jumps = np.flatnonzero(np.diff(together) > YEAR_NS) + 1
    if not len(jumps):
        return None
    edges = np.concatenate([[0], jumps, [len(together)]])
    most = int(np.argmax(np.diff(edges)))
    if 2 * (edges[most + 1] - edges[most]) <= len(together):  # the stamps have another unit
        return None
    return int(together[edges[most]]), int(together[edges[most + 1] - 1])


def main_span_of(
    extent_ns: tuple[int, int], blocks: Callable[[], Iterable[Mapping[str, Stream]]]
) -> tuple[int, int] | None:
    """Compute `main_span` of a log; its blocks are read only if the log is over a year long."""
    if extent_ns[1] - extent_ns[0] <= YEAR_NS:
        return None
    return main_span(each.publish_time_ns for block in blocks() for each in block.values())


class Rejections(dict[str, Counter[str]]):
    """Counts of impossible messages that are left out, by topic and by reason."""

    def note(self, topic: str, found: Counter[str]) -> None:
        """Record the messages that a read left out of a topic; repeated reads are not added up."""
        self[topic] = self.get(topic, Counter()) | found

    def sentence(self, topic: str) -> str:
        """Describe the messages that are left out of a topic."""
        return "; ".join(
            f"{count} {'message is' if count == 1 else 'messages are'} left out: {why}"
            for why, count in self[topic].items()
        )

    def plus(self, others: Iterable["Rejections"]) -> "Rejections":
        """Add the counts of several runs."""
        total = Rejections(self)
        for other in others:
            for topic, found in other.items():
                total[topic] = total.get(topic, Counter()) + found
        return total


@lru_cache(maxsize=1024)
def limit_of(name: str) -> float:
    """Return the largest possible value of a field or component, by the unit in its name.

    >>> limit_of("range_m"), limit_of("covariance_m2"), limit_of("quaternion")
    (1000000000000.0, 1e+50, 1e+50)
    """
    return LIMITS.get(unit_of(name), LIMIT)


def _components(stream: Stream, field: str) -> list[str]:
    """Name the components of a field, by the channel's components or by the field's name."""
    column = stream.columns[field]
    if column.ndim == 1:
        return [field]
    width = column.shape[1]
    if field in ("state", "mean", "value") and len(stream.components) == width:
        return stream.components
    return [field] * width
