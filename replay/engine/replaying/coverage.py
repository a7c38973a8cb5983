"""Measures for how much of each run a case was estimated, from the stamps of its estimates."""

import math

import numpy as np
from numpy.typing import NDArray

from replay.engine.compiling.compile import compile_over_runs
from replay.engine.streams.blocks import Ragged

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Coverage:
    """At what intervals a case's estimates come, run by run, in bins of factors of two.

    Intervals much longer than the usual one, and than a second, are gaps.
    """

    BINS = 64
    SECOND = 30  # the bin of intervals about one second long, 2^30 ns
    GAP = 4  # a gap is this many bins beyond the median: 8 to 32 times as long

    def __init__(self, topic: str, starts_ns: Integers) -> None:
        self.topic = topic
        self.last_ns = starts_ns.copy()
        self.said = np.zeros(len(starts_ns), bool)
        # a bin's runs side by side: most runs use one or two bins, and the rest is never touched
        self._counts = np.zeros((self.BINS, len(starts_ns)), np.int64)
        self._sums_ns = np.zeros((self.BINS, len(starts_ns)))

    def note(self, estimates: Ragged) -> None:
        """Take in the stamps of a block."""
        times_ns = estimates.stream.publish_time_ns
        noted = self.said, self.last_ns, self._counts, self._sums_ns
        _note_intervals(estimates.runs, estimates.offsets, times_ns, *noted)

    def estimated_s(self) -> Floats:
        """For how long (runs,) there were estimates, gaps left out."""
        is_gap = np.arange(self.BINS)[:, None] > self._longest()
        return np.where(is_gap, 0, self._sums_ns).sum(axis=0) * 1e-9

    def misses(self, now_ns: Integers) -> NDArray[np.bool_]:
        """Tell whether the time (runs,) since each run's last estimate is a gap."""
        interval = _bin_of(now_ns - self.last_ns)
        missed: NDArray[np.bool_] = interval > self.SECOND
        return missed & (interval > self._longest()) if missed.any() else missed

    def _longest(self) -> Integers:
        """Return the bin (runs,) of the longest intervals that are no gaps."""
        reached = np.cumsum(self._counts, axis=0)
        median = np.argmax(2 * reached >= reached[-1], axis=0)
        return np.maximum(median + self.GAP, self.SECOND)


def _bin_of(interval_ns: Integers) -> Integers:
    return np.frexp(np.maximum(interval_ns, 1).astype(float))[1].astype(np.int64) - 1


def note_intervals(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    said: NDArray[np.bool_],
    last_ns: Integers,
    counts: Integers,
    sums_ns: Floats,
) -> None:
    """Take in the stamps of a run; see `Coverage`.

    Args:
        run: which.
        offsets: (runs + 1,) of the stamps.
        time_ns: (n,) the stamps.
        said: (runs,) whether there were any.
        last_ns: (runs,) the last one; negative where there is none.
        counts: (BINS, runs) of the intervals of every bin, how many there are.
        sums_ns: (BINS, runs) and their sum, exact up to 2^53 ns, a hundred days.
    """
    for row in range(offsets[run], offsets[run + 1]):
        interval = time_ns[row] - last_ns[run]
        if last_ns[run] >= 0 and interval > 0:
            _, exponent = math.frexp(float(interval))
            counts[exponent - 1, run] += 1
            sums_ns[exponent - 1, run] += interval
        said[run], last_ns[run] = True, time_ns[row]


_note_intervals = compile_over_runs(note_intervals, allocates=False)
