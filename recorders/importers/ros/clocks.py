"""Comparison of the clocks of a bag: stamps of headers and of the bag, by topic."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import to_ns


@dataclass
class Clocks:
    """The spans of the header's stamps, the bag's stamps and their difference, in ns, by topic."""

    header: dict[str, tuple[int, int]] = field(default_factory=dict)
    bag: dict[str, tuple[int, int]] = field(default_factory=dict)
    offset: dict[str, tuple[int, int]] = field(default_factory=dict)

    def note(
        self, topic: str, stamp_ns: NDArray[np.int64] | None, log_time_ns: NDArray[np.int64]
    ) -> None:
        """Add the stamps of some messages (n,); if they have no header, only those of the bag."""
        if stamp_ns is not None:  # zero means no stamp
            stamp_ns, log_time_ns = stamp_ns[stamp_ns != 0], log_time_ns[stamp_ns != 0]
        if not len(log_time_ns):
            return
        if stamp_ns is not None:
            _widen(self.header, topic, stamp_ns)
        _widen(self.bag, topic, log_time_ns)
        behind = 0 * log_time_ns if stamp_ns is None else to_ns(log_time_ns, 1, -stamp_ns, where=topic)
        _widen(self.offset, topic, behind)

    def check(self, path: Path, tolerance_s: float) -> None:
        """Raise BadInput if topics have stamps of unrelated clocks."""
        early = min(self.offset, key=lambda topic: self.offset[topic][1], default="")
        late = max(self.offset, key=lambda topic: self.offset[topic][0], default="")
        apart_s = (self.offset[late][0] - self.offset[early][1]) * 1e-9 if self.offset else 0.0
        if apart_s > tolerance_s:
            what = [
                each if each in self.header else f"{each} (no header, the bag's)"
                for each in (early, late)
            ]
            raise BadInput(
                f"{path}: mixed time bases: the stamps of {what[0]} and of {what[1]} are "
                f"{apart_s:.6g} s apart; use --clock bag, or topics of one clock with --set topics=[...]"
            )

    def notes(self) -> dict[str, str]:
        """Describe both clocks and their offset."""
        found = {}
        for name, spans in (("header", self.header), ("bag", self.bag)):
            if spans:
                found[f"{name} clock"] = " to ".join(_date(each) for each in _span(spans.values()))
        if self.header:
            low, high = _span(self.offset[topic] for topic in self.header)
            found["bag clock minus header clock"] = f"{low * 1e-9:.3f} to {high * 1e-9:.3f} s"
        return found


def _widen(spans: dict[str, tuple[int, int]], topic: str, values: NDArray[np.int64]) -> None:
    own = int(values.min()), int(values.max())
    spans[topic] = _span([own, spans.get(topic, own)])


def _span(spans: Iterable[tuple[int, int]]) -> tuple[int, int]:
    lows, highs = zip(*spans, strict=True)
    return min(lows), max(highs)


def _date(stamp_ns: int) -> str:
    """Format a stamp as a date, or in seconds if it is before 2000, as in simulations."""
    if stamp_ns < 946_684_800_000_000_000:
        return f"{stamp_ns * 1e-9:.3f} s"
    return f"{datetime.fromtimestamp(stamp_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"
