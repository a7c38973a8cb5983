"""Weighted samples from the factor of a covariance, and their means and covariances.

All sums are kept in registers, because a compiler must assume that arrays overlap. If a tuple changes, a
kernel reads all of it at every mention of its name; such tuples are therefore iterated over, not
indexed.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Protocol

from fuselog.replay.engine.arrays import Floats, Numbers
from fuselog.replay.inference.linear_algebra.tuples import total

REGISTERS = 32  # number of a processor's registers; further sums are kept in memory


class Offset(Protocol):
    """Function that multiplies a triangle, as `lower_of` reads it, by a row of points (L, N)."""

    def __call__(self, lower: Numbers, points: Floats, index: int, /) -> Numbers: ...


class Moments(Protocol):
    """Function that fills weighted covariances of values; see `moments_of`."""

    def __call__(
        self,
        weights: Floats,
        offsets: Floats,
        found: Floats,
        shift: Floats,
        spread: Floats,
        cross: Floats,
        /,
    ) -> None: ...


class WeightedMean(Protocol):
    """Function that fills the weighted sums (v,) of values (L, v)."""

    def __call__(self, weights: Floats, found: Floats, mean: Floats, /) -> None: ...


@lru_cache(maxsize=64)
def lower_of(size: int) -> Callable[[Floats], Numbers]:
    """Make `read(factor)`, which returns the rows of a lower triangle as one tuple."""
    places = tuple((row, column) for row in range(size) for column in range(row + 1))

    def read(factor: Floats) -> Numbers:
        return tuple(factor[row, column] for row, column in places)

    return read


@lru_cache(maxsize=64)
def offset_of(size: int) -> Offset:
    """Make `offset(lower, points, index)`: a triangle, as `lower_of` reads it, times a row of points."""
    firsts = tuple(row * (row + 1) // 2 for row in range(size))

    def offset(lower: Numbers, points: Floats, index: int) -> Numbers:
        return tuple(
            total(tuple(lower[first + k] * points[index, k] for k in range(row + 1)))
            for row, first in enumerate(firsts)
        )

    return offset


@lru_cache(maxsize=64)
def moments_of(states: int, values: int) -> Moments:
    """Make `moments(weights, offsets, found, shift, spread, cross)`, which fills weighted covariances.

    These are the covariances of the values `found` (L, v) minus `shift` (v,) with each other and with
    the offsets (L, >= t).
    """
    parts = tuple(_moments_of_some(states, chosen) for chosen in _in_parts(states, values))

    def moments(
        weights: Floats, offsets: Floats, found: Floats, shift: Floats, spread: Floats, cross: Floats
    ) -> None:
        for fill in parts:
            fill(weights, offsets, found, shift, spread, cross)

    return moments


def _in_parts(states: int, values: int) -> list[range]:
    """Split the values into parts whose sums fit into the registers; a part has at least one value."""
    parts = [range(0)]
    for i in range(values):
        own = range(parts[-1].start, i + 1)
        fits = sum(states + each + 1 for each in own) <= REGISTERS
        parts[-1:] = [own] if fits or not parts[-1] else [parts[-1], range(i, i + 1)]
    return parts


def _moments_of_some(states: int, chosen: range) -> Moments:
    """Make `moments` for some values, with each other and with earlier values, in one loop."""
    pairs = tuple((i, j) for i in chosen for j in range(i + 1))
    mixed = tuple((row, i) for row in range(states) for i in chosen)
    size, first = chosen.stop, chosen.start

    def fill(
        weights: Floats, offsets: Floats, found: Floats, shift: Floats, spread: Floats, cross: Floats
    ) -> None:
        centre = tuple(shift[i] for i in range(size))
        own, joint = (0.0,) * len(pairs), (0.0,) * len(mixed)
        for k in range(len(weights)):
            y = tuple(found[k, i] - centre[i] for i in range(size))
            weighed = tuple(weights[k] * y[i] for i in chosen)
            x = tuple(offsets[k, row] for row in range(states))
            own = tuple(
                sofar + weighed[i - first] * y[j] for sofar, (i, j) in zip(own, pairs, strict=True)
            )
            joint = tuple(
                sofar + x[row] * weighed[i - first] for sofar, (row, i) in zip(joint, mixed, strict=True)
            )
        for entry, (i, j) in zip(own, pairs, strict=True):
            spread[i, j] = spread[j, i] = entry
        for entry, (row, i) in zip(joint, mixed, strict=True):
            cross[row, i] = entry

    return fill


@lru_cache(maxsize=64)
def weighted_mean_of(values: int) -> WeightedMean:
    """Make `fill(weights, found, mean)`, which fills the weighted sums (v,) of values (L, v)."""

    def fill(weights: Floats, found: Floats, mean: Floats) -> None:
        sums = (0.0,) * values
        for k in range(len(weights)):
            sums = tuple(sofar + weights[k] * found[k, i] for i, sofar in enumerate(sums))
        for i, entry in enumerate(sums):
            mean[i] = entry

    return fill
