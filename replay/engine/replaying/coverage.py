"""Share of each run's time that a case's estimates cover, computed from the estimates' stamps."""

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.replay.engine.streams.blocks import Ragged

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Coverage:
    """Counts of the intervals between a case's estimates, by run, in bins whose widths double.

    Intervals much longer than both the median and a second are gaps. The last block is counted only
    when a result is requested.
    """

    BINS = 64
    SECOND = 30  # the bin of intervals about one second long, 2^30 ns
    GAP = 4  # a gap is more bins than this above the median, so at least 16 times as long

    def __init__(self, topic: str, starts_ns: Integers) -> None:
        self.topic = topic
        self.last_ns = starts_ns
        self.has_estimates = np.zeros(len(starts_ns), bool)
        self._runs = len(starts_ns)
        self._last_block: tuple[Integers, ...] = ()

    def note(self, estimates: Ragged) -> None:
        """Add the stamps of a block."""
        self._count()
        offsets, time_ns = estimates.offsets, estimates.stream.publish_time_ns
        self._last_block = offsets, time_ns, self.last_ns
        if len(time_ns):
            ends = offsets[1:]
            has_some = ends > offsets[:-1]
            last_ns = time_ns.take(ends - 1)
            if np.count_nonzero(has_some) < len(has_some):  # keep those of runs without stamps
                last_ns = np.where(has_some, last_ns, self.last_ns)
                has_some |= self.has_estimates
            self.has_estimates, self.last_ns = has_some, last_ns

    @cached_property
    def _counts(self) -> Integers:
        """Return the number of intervals in each bin and run (BINS, runs).

        Most runs use one or two bins, so most of the memory is never touched and never allocated.
        """
        return np.zeros((self.BINS, self._runs), np.int64)

    @cached_property
    def _sums_ns(self) -> Floats:
        """Return the total length of the intervals in each bin and run (BINS, runs)."""
        return np.zeros((self.BINS, self._runs))

    def _count(self) -> None:
        if self._last_block:
            _count_intervals(self._runs, *self._last_block, self._counts, self._sums_ns)
            self._last_block = ()

    def estimated_s(self) -> Floats:
        """Compute the time in s (runs,) that estimates cover, excluding gaps."""
        self._count()
        is_gap = np.arange(self.BINS)[:, None] > self._longest()
        seconds: Floats = np.where(is_gap, 0, self._sums_ns).sum(axis=0) * 1e-9
        return seconds

    def misses(self, now_ns: Integers) -> NDArray[np.bool_]:
        """Test whether the time (runs,) from each run's last estimate to `now_ns` is a gap."""
        since_ns = now_ns - self.last_ns
        missed: NDArray[np.bool_] = since_ns >= 2 << self.SECOND
        return missed & (_bin_of(since_ns) > self._longest()) if missed.any() else missed

    def _longest(self) -> Integers:
        """Return the bin (runs,) of the longest intervals that are not gaps."""
        self._count()
        reached = np.cumsum(self._counts, axis=0)
        median = np.argmax(2 * reached >= reached[-1], axis=0)
        longest: Integers = np.maximum(median + self.GAP, self.SECOND)
        return longest


def _bin_of(interval_ns: Integers) -> Integers:
    power: Integers = np.frexp(np.maximum(interval_ns, 1).astype(float))[1].astype(np.int64) - 1
    return power


def count_intervals(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    before_ns: Integers,
    counts: Integers,
    sums_ns: Floats,
) -> None:
    """Count the intervals between the stamps of a run; see `Coverage`.

    Args:
        run: number of the run.
        offsets: (runs + 1,) first stamp of each run.
        time_ns: (n,) the stamps.
        before_ns: (runs,) the last stamp before this block; negative if the run has no earlier stamp.
        counts: (BINS, runs) number of intervals in each bin, updated.
        sums_ns: (BINS, runs) total length of these intervals, updated; exact up to 2^53 ns, a hundred
            days.
    """
    last_ns = before_ns[run]
    for row in range(offsets[run], offsets[run + 1]):
        interval = time_ns[row] - last_ns
        if last_ns >= 0 and interval > 0:
            _, exponent = math.frexp(float(interval))
            counts[exponent - 1, run] += 1
            sums_ns[exponent - 1, run] += interval
        last_ns = time_ns[row]


_count_intervals = compile_over_runs(count_intervals)
