"""Sums in bins, for errors whose number is not known in advance."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class BinnedSums:
    """Sums of rows of numbers (n, columns) by group and by bin of a position, an integer >= 0.

    Bin b contains the positions from b × width to (b + 1) × width. If there is a `limit` of bins per
    group, the width is doubled until the limit is met. `cells` limits the number of bins of all groups
    in the same way, but only when sums are merged. `first` is the first group; nothing is stored for
    groups before it.
    """

    def __init__(
        self,
        columns: int,
        *,
        width: int = 1,
        limit: int | None = None,
        cells: int | None = None,
        first: int = 0,
    ) -> None:
        self.width = width
        self._first = first
        self._limit = limit
        self._cells = cells
        # first column: number of rows
        self._sums: Floats = np.zeros((1, 0, 1 + columns))
        self._bins = 0
        self._groups = 0

    def add(self, position: Integers, values: Floats, group: Integers | None = None) -> None:
        """Add rows (n, columns) at positions (n,) to groups (n,), or to the first group by default."""
        if len(position):
            with self.filling(position, group) as bins:
                _fill_sums(values, bins)

    @contextmanager
    def filling(self, position: Integers, group: Integers | None = None) -> Iterator["Bins"]:
        """Yield empty bins for rows at positions (n,) in groups (n,), and add what they are filled with.

        There must be a row.
        """
        group = np.full(len(position), self._first) if group is None else group
        self._widen(int(position.max()))
        low, high = (max(int(end), 0) // self.width for end in (position.min(), position.max()))
        first, last = int(group.min()), int(group.max())
        begin, end, count = first - self._first, last + 1 - self._first, high + 1 - low
        self._reserve(end, high + 1)
        sums = np.zeros((end - begin, count, self._sums.shape[2]))
        yield Bins(position, group, self.width, low, first, count, sums.reshape(-1, sums.shape[2]))
        self._sums[begin:end, low : high + 1] += sums

    def merge(self, other: "BinnedSums") -> None:
        """Add sums with the same columns and without groups before the first group of this object."""
        theirs = other._sums[: other._groups, : other._bins]
        while self.width < other.width:
            self._double()
        width = other.width
        while width < self.width:
            theirs, width = _halved(theirs), 2 * width
        begin = other._first - self._first
        end = begin + len(theirs)
        self._reserve(end, theirs.shape[1])
        self._sums[begin:end, : theirs.shape[1]] += theirs
        while self._limit is not None and self._bins > self._limit:
            self._double()
        while self._cells is not None and self._bins > 1 and self._groups * self._bins > self._cells:
            self._double()

    def filled(self) -> tuple[Integers, Floats, Floats]:
        """Return the cells with rows: group and bin (m, 2), count (m,) and sums (m, columns)."""
        used = self._sums[: self._groups, : self._bins]
        cells = np.argwhere(used[:, :, 0] > 0)
        rows = used[cells[:, 0], cells[:, 1]]
        cells[:, 0] += self._first
        return cells, rows[:, 0], rows[:, 1:]

    def by_group(self) -> tuple[Integers, Floats, Floats]:
        """Return the groups with rows (m,), counts (m,), and sums over all bins (m, columns)."""
        sums = self._sums[: self._groups, : self._bins].sum(axis=1)
        groups = np.flatnonzero(sums[:, 0] > 0)
        return groups + self._first, sums[groups, 0], sums[groups, 1:]

    def _widen(self, position: int) -> None:
        while self._limit is not None and position // self.width >= self._limit:
            self._double()

    def _double(self) -> None:
        self._sums = _halved(self._sums[:, : self._bins])
        self._bins = self._sums.shape[1]
        self.width *= 2

    def _reserve(self, groups: int, bins: int) -> None:
        """Grow the arrays if necessary, with extra room so that they are rarely copied."""
        there = self._sums.shape
        self._groups, self._bins = max(self._groups, groups), max(self._bins, bins)
        if groups > there[0] or bins > there[1]:
            wanted = [
                have if need <= have else max(need, have + have // 2)
                for need, have in ((groups, there[0]), (bins, there[1]))
            ]
            grown = np.zeros((*wanted, there[2]))
            grown[: there[0], : there[1]] = self._sums
            self._sums = grown


def _halved(sums: Floats) -> Floats:
    """Add up pairs of adjacent bins."""
    even = np.pad(sums, ((0, 0), (0, sums.shape[1] % 2), (0, 0)))
    return even[:, 0::2] + even[:, 1::2]


class Bins(NamedTuple):
    """Bins that a kernel fills.

    Attributes:
        position, group: (n,) of the rows.
        width: width of a bin.
        low, first: the first bin and the first group.
        in_group: number of bins of a group.
        sums: (groups × bins, 1 + columns), row counts and column sums.
    """

    position: Integers
    group: Integers
    width: int
    low: int
    first: int
    in_group: int
    sums: Floats


def bin_of(bins: Bins, row: int) -> Floats:
    """Return the count and sums (1 + columns,) of the bin to which a row belongs."""
    place = max(bins.position[row], 0) // bins.width - bins.low
    return bins.sums[(bins.group[row] - bins.first) * bins.in_group + place]


def fill_sums(values: Floats, bins: Bins) -> None:
    """Sum rows of numbers in their bins.

    Args:
        values: (n, columns), the rows.
        bins: the bins, which are filled.
    """
    for row in range(len(values)):
        own = bin_of(bins, row)
        own[0] += 1.0
        for column in range(values.shape[1]):
            own[1 + column] += values[row, column]


_fill_sums = compiled(fill_sums)
