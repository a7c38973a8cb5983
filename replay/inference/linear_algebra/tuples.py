"""Conversion between the tuples of a model's functions and the arrays of kernels.

A kernel can index a tuple only by numbers that are known at compile time: loops over tuples have a known
range and are unrolled (`range_of`).
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

from fuselog.replay.engine.arrays import Floats, Numbers


class ReadTuple(Protocol):
    """Function that reads entries of an array (n,), or of a tuple, as a tuple."""

    def __call__(self, array: Floats | Numbers, /) -> Numbers: ...


class Fill(Protocol):
    """Function that writes numbers to the first entries of an array (n,)."""

    def __call__(self, array: Floats, values: Sequence[float] | Floats, /) -> None: ...


class AddNoise(Protocol):
    """Function that adds variances, or rows of a lower triangle, to a covariance (t, t)."""

    def __call__(self, covariance: Floats, noise: Sequence[float] | Floats, /) -> None: ...


def range_of(start: int, end: int | None = None) -> tuple[int, ...]:
    """Return the numbers of `range` as a tuple, for a loop that is unrolled."""
    return tuple(range(start) if end is None else range(start, end))


@lru_cache(maxsize=256)
def tuple_of(size: int, start: int = 0) -> ReadTuple:
    """Make `read(array)`, which returns `size` entries of an array, beginning at `start`, as a tuple."""

    def read(array: Floats | Numbers) -> Numbers:
        return tuple(array[start + index] for index in range(size))

    return read


@lru_cache(maxsize=256)
def filling(size: int) -> Fill:
    """Make `fill(array, values)`, which copies the first entries of a tuple to an array."""

    def fill(array: Floats, values: Sequence[float] | Floats) -> None:
        for index in range_of(size):
            array[index] = values[index]

    return fill


def total(numbers: Sequence[float]) -> float:
    """Sum a tuple of numbers in order; the rounding of `sum` depends on the version of Python."""
    found = numbers[0]
    for number in numbers[1:]:
        found = found + number
    return found


@lru_cache(maxsize=64)
def adding_noise(size: int, block: int = 0) -> AddNoise:
    """Make `add(covariance, noise)`, which adds a tuple of variances or of a lower triangle.

    The triangle covers the first `block` components (all by default), followed by the variances of the
    other components.
    """
    corner = block or size
    triangle = tuple((row, column) for row in range(corner) for column in range(row + 1))
    triangle += tuple((row, row) for row in range(corner, size))

    def add(covariance: Floats, noise: Sequence[float] | Floats) -> None:
        if len(noise) == size:
            for row in range_of(size):
                covariance[row, row] += noise[row]
        else:
            for entry, (row, column) in enumerate(triangle):
                covariance[row, column] += noise[entry]
                if column < row:
                    covariance[column, row] += noise[entry]

    return add
