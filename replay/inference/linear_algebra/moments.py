"""Weighted samples from the factor of a covariance, and their means and covariances.

All sums are kept in registers, because a compiler must assume that arrays overlap. Whenever a kernel
names a tuple that changes, it reads the whole tuple; loops therefore iterate over such tuples instead of
indexing them.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Protocol

from fuselog.replay.engine.arrays import Floats, Integers, Numbers
from fuselog.replay.inference.linear_algebra.tuples import total

REGISTERS = 32  # number of a processor's registers; further sums are kept in memory


class Offset(Protocol):
    """Function that multiplies a triangle, as `lower_of` reads it, by a row of points (L, N)."""

    def __call__(self, lower: Numbers, points: Floats, index: int, /) -> Numbers: ...


class AxisOffset(Protocol):
    """Function that multiplies a lower triangle (N, N) by a point (N,) on an axis."""

    def __call__(self, factor: Floats, axis: int, point: Floats, /) -> Numbers: ...


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


class AxisMoments(Protocol):
    """Function that fills weighted covariances of values; see `axis_moments_of`."""

    def __call__(
        self,
        samples: tuple[Floats, Floats, Integers],
        factor: Floats,
        found: Floats,
        shift: Floats,
        joint: Floats,
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
def axis_offset_of(size: int) -> AxisOffset:
    """Make `offset(factor, axis, point)`: a lower triangle times a point (N,) on one axis.

    The entries of the factor above its diagonal are zero.
    """

    def offset(factor: Floats, axis: int, point: Floats) -> Numbers:
        length = point[axis]
        return tuple(factor[row, axis] * length for row in range(size))

    return offset


@lru_cache(maxsize=64)
def moments_of(states: int, places: tuple[int, ...]) -> Moments:
    """Make `moments(weights, offsets, found, shift, spread, cross)`, which fills weighted covariances.

    These are covariances of some components of the values `found` (L, v) minus `shift` (v,), with each
    other and with the offsets (L, >= t).
    """
    parts = tuple(
        _moments_of_some(states, places[: chosen.stop], places[chosen.start : chosen.stop])
        for chosen in _in_parts(states, len(places))
    )

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


def _moments_of_some(states: int, places: tuple[int, ...], chosen: tuple[int, ...]) -> Moments:
    """Make `moments` for the last values, with each other and with earlier values, in one loop."""
    first = len(places) - len(chosen)
    pairs = tuple((i, j) for i in range(first, len(places)) for j in range(i + 1))
    own_places = tuple((places[i], places[j]) for i, j in pairs)
    mixed = tuple((row, i) for row in range(states) for i in range(len(chosen)))
    joint_places = tuple((row, chosen[i]) for row, i in mixed)

    def fill(
        weights: Floats, offsets: Floats, found: Floats, shift: Floats, spread: Floats, cross: Floats
    ) -> None:
        centre = tuple(shift[i] for i in places)
        own, joint = (0.0,) * len(pairs), (0.0,) * len(mixed)
        for k in range(len(weights)):
            y = tuple(found[k, i] - c for i, c in zip(places, centre, strict=True))
            weighed = tuple(weights[k] * each for each in y[first:])
            x = tuple(offsets[k, row] for row in range(states))
            own = tuple(
                sofar + weighed[i - first] * y[j] for sofar, (i, j) in zip(own, pairs, strict=True)
            )
            joint = tuple(
                sofar + x[row] * weighed[i] for sofar, (row, i) in zip(joint, mixed, strict=True)
            )
        for entry, (i, j) in zip(own, own_places, strict=True):
            spread[i, j] = spread[j, i] = entry
        for entry, (row, i) in zip(joint, joint_places, strict=True):
            cross[row, i] = entry

    return fill


@lru_cache(maxsize=64)
def axis_moments_of(states: int, values: int, kept: tuple[int, ...]) -> AxisMoments:
    """Make `moments`, which fills weighted covariances of values at samples that are on axes.

    With the points (L, N), the k-th of which is on axis `axes[k]`, and the lower factor (N, N) of their
    covariance, the covariance of states and values is the product of the factor with `joint` (N, v), the
    covariance of points and values. Values that are `kept` are components of the state that the function
    does not change; their covariance with all values is therefore the covariance of these states with
    the values.
    """
    spread_out = moments_of(0, tuple(each for each in range(values) if each not in kept))

    def moments(
        samples: tuple[Floats, Floats, Integers],
        factor: Floats,
        found: Floats,
        shift: Floats,
        joint: Floats,
        spread: Floats,
        cross: Floats,
    ) -> None:
        weights, points, axes = samples
        spread_out(weights, points, found, shift, spread, cross)
        joint[:, :] = 0.0
        for k in range(len(weights)):
            axis = axes[k]
            share = weights[k] * points[k, axis]
            for i in range(values):
                joint[axis, i] += share * (found[k, i] - shift[i])
        for row in range(states):
            sums = (0.0,) * values
            for k in range(row + 1):
                sums = tuple(sofar + factor[row, k] * joint[k, i] for i, sofar in enumerate(sums))
            for i, entry in enumerate(sums):
                cross[row, i] = entry
        for row in kept:
            for i in range(values):
                spread[row, i] = spread[i, row] = cross[row, i]

    return moments


@lru_cache(maxsize=64)
def weighted_mean_of(places: tuple[int, ...]) -> WeightedMean:
    """Make `fill(weights, found, mean)`: weighted sums (v,) of values (L, v), for some components."""

    def fill(weights: Floats, found: Floats, mean: Floats) -> None:
        sums = (0.0,) * len(places)
        for k in range(len(weights)):
            sums = tuple(sofar + weights[k] * found[k, i] for i, sofar in zip(places, sums, strict=True))
        for i, entry in zip(places, sums, strict=True):
            mean[i] = entry

    return fill
