"""Checks of the order of times: single late rows are sorted, a clock that was reset is rejected."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import NOT_A_TIME, Stamps
from fuselog.recorders.importers.tables.times import DIGITS, TimeMapping

# How many successive rows, and by how many usual steps, are behind an earlier row if a clock was reset.
_ROWS, _STEPS = 10, 5.0
_ROWS_AT_END = 3
# Beyond this number of usual steps, a single row is not late, but has another clock or no time.
_FAR_STEPS = 100.0
# The share of steps that go back in a file with the newest row first.
_REVERSED = 0.9
# Numbers at which counters roll over: powers of two, and days and weeks in several units.
_ROLLOVERS = (
    *(2**bits for bits in (16, 24, 31, 32)),
    *(span * 10**digits for digits in (0, 3, 6) for span in (86_400, 604_800)),
    *(10**digits for digits in (4, 5, 6, 7, 8, 9)),
    60, 3600, 60_000,
)  # fmt: skip


class Order:
    """A check of the order of one clock's stamps; `label` names the file and the column."""

    def __init__(self, label: str, mapping: TimeMapping) -> None:
        self._label, self._is_any = label, mapping.order == "any"
        self._unit_ns = 10 ** DIGITS[str(mapping.unit)] if str(mapping.unit) in DIGITS else 0
        self._zero_ns = mapping.zero_ns
        self._usual_ns = 0.0
        self._first_ns = self._reached_ns = NOT_A_TIME
        self._behind = 0  # rows behind the latest, up to now
        self._fall: tuple[int, int, int] | None = None  # its row, from where and to where

    def follow(self, stamps: Stamps, rows: NDArray[np.int64]) -> None:
        """Process the next stamps (n,) and their row numbers; raises BadInput like `end`."""
        if self._is_any or not len(stamps):
            return
        steps = np.diff(stamps)
        if not self._usual_ns and (steps > 0).any():
            self._usual_ns = float(np.median(steps[steps > 0]))
        if self._reached_ns == NOT_A_TIME:
            self._first_ns = self._reached_ns = int(stamps[0])
        if stamps[0] >= self._reached_ns and (not len(steps) or steps.min() >= 0):
            self._reached_ns, self._behind = int(stamps[-1]), 0
            return
        highest = np.maximum.accumulate(np.append(self._reached_ns, stamps))
        behind = stamps < highest[:-1]
        self._reached_ns = int(highest[-1])
        edges = np.flatnonzero(np.diff(np.concatenate([[0], behind.astype(np.int8), [0]])))
        for begin, end in edges.reshape(-1, 2):
            if begin > 0 or not self._behind:
                self._behind = 0
                self._fall = int(rows[begin]), int(highest[begin]), int(stamps[begin])
            self._behind += int(end - begin)
            self._check(_ROWS)
        if not behind[-1]:
            self._behind = 0

    def end(self) -> None:
        """Raise BadInput if the last rows are behind earlier ones."""
        self._check(_ROWS_AT_END)

    def _check(self, fewest: int) -> None:
        if self._fall is None or not self._behind:
            return
        row, high, low = self._fall
        is_last = fewest == _ROWS_AT_END and high - low > 0.5 * (high - self._first_ns)
        is_before = low < self._first_ns - _FAR_STEPS * self._usual_ns
        is_clear = high - low > _STEPS * self._usual_ns
        if not (is_clear and (is_last or is_before or self._behind >= fewest)):
            return
        rollover = self._rollover(high, low)
        unwrap = f"`rollover = {rollover}` if the counter rolled over, " if rollover else ""
        raise BadInput(
            f"{self._label}: at row {row + 1} the time falls from {_written(high)} to {_written(low)}; "
            f'add to `time` {unwrap}`order = "any"` if rows are to be sorted by their times, or to the '
            'table `vehicle = "COLUMN"` if a column names the vehicle of each row; if the clock was '
            "restarted or set back, split the file there"
        )

    def _rollover(self, high_ns: int, low_ns: int) -> int:
        if not self._unit_ns:
            return 0
        high, low = ((each - self._zero_ns) / self._unit_ns for each in (high_ns, low_ns))
        return rollover_of(np.array([high, low]), self._usual_ns / self._unit_ns)


def rollover_of(counts: NDArray, usual: float) -> int:
    """Return the number at which a counter rolls over; 0 if its falls are not rollovers.

    Args:
        counts: (n,), readings of the counter.
        usual: usual step, by which the counter continues after a rollover.
    """
    steps = np.diff(counts)
    falls = np.flatnonzero(steps < 0)
    if not len(falls):
        return 0
    fitting = {}
    for number in _ROLLOVERS:
        onward = counts[falls + 1] + number - counts[falls]
        if (
            np.all(onward > 0.2 * usual)
            and np.all(onward < 5.0 * usual)
            and counts.max() < number + usual
        ):
            fitting[number] = float(np.abs(onward - usual).max())
    return min(fitting, key=lambda each: fitting[each]) if fitting else 0


def is_reversed(parts: Sequence[Stamps]) -> bool:
    """Test whether rows are newest first, for each vehicle separately."""
    steps = np.concatenate([np.diff(part[part != NOT_A_TIME]) for part in parts] or [np.empty(0)])
    moving = steps[steps != 0]
    return len(moving) > 1 and float(np.mean(moving < 0)) >= _REVERSED


def _written(stamp_ns: int) -> str:
    return str(pd.Timestamp(stamp_ns))
