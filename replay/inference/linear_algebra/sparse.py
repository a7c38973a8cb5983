"""Propagation of covariances through matrices whose zeros and ones are known in advance.

For each row of a matrix, a `Pattern` lists the entries that may be nonzero: the column, and the value if
it is constant. Only products with zero are left out, so the order of summation does not change.
"""

from collections.abc import Mapping
from typing import Protocol

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.inference.linear_algebra.gaussian import (
    add_through,
    measured_covariance,
    propagate_covariance,
)

Row = tuple[tuple[int, float | None], ...]
Pattern = tuple[Row, ...]


class Propagate(Protocol):
    """Function that replaces P (t, t) by F P F' and fills F P (t, t)."""

    def __call__(self, covariance: Floats, transition: Floats, product: Floats, /) -> None: ...


class MeasureCovariance(Protocol):
    """Function that fills C = P H' (t, m) and S = H C (m, m), from P (t, t) and rows H (m, t)."""

    def __call__(self, covariance: Floats, rows: Floats, cross: Floats, spread: Floats, /) -> None: ...


class AddThrough(Protocol):
    """Function that adds G diag(variances) G' to a covariance (t, t), with a gain G (t, k)."""

    def __call__(self, covariance: Floats, gain: Floats, variances: Floats, /) -> None: ...


def pattern_of(known: Mapping[tuple[int, int], float | None] | None, rows: int) -> Pattern | None:
    """Make the pattern of a matrix with `rows` rows from its entries by index (None: not constant)."""
    if known is None:
        return None
    return tuple(
        tuple((column, value) for (at, column), value in sorted(known.items()) if at == row)
        for row in range(rows)
    )


def propagating_covariance(pattern: Pattern | None) -> Propagate:
    """Make `move(covariance, transition, product)`, which replaces P (t, t) by F P F'.

    `product` becomes F P. Components that F does not change, such as a bias, need no sums.
    """
    if pattern is None:
        return propagate_covariance
    rows = tuple(enumerate(pattern))
    moved = tuple((row, entries) for row, entries in rows if entries != ((row, 1.0),))
    left = tuple(row for row, entries in rows if entries == ((row, 1.0),))

    def move(covariance: Floats, transition: Floats, product: Floats) -> None:
        for row, entries in moved:
            total = 0.0
            for k, value in entries:
                total += (transition[row, k] if value is None else value) * covariance[k]
            product[row] = total
        for row in left:
            product[row] = covariance[row]
        for row, entries in moved:
            covariance[row] = product[row]
            factors = tuple(transition[row, k] if value is None else value for k, value in entries)
            for column, _ in moved:
                if column >= row:
                    entry = 0.0
                    for factor, (k, _) in zip(factors, entries, strict=True):
                        entry += product[column, k] * factor
                    covariance[row, column] = entry
        for row, _ in moved:
            for column, _ in rows:
                if column > row or column in left:
                    covariance[column, row] = covariance[row, column]

    return move


def measuring_covariance(pattern: Pattern | None) -> MeasureCovariance:
    """Make `measure(covariance, rows, cross, spread)`, which fills C = P H' and S = H C; H is `rows`."""
    if pattern is None:
        return measured_covariance
    rows_of = tuple(enumerate(pattern))

    def measure(covariance: Floats, rows: Floats, cross: Floats, spread: Floats) -> None:
        for i, entries in rows_of:
            for row in range(len(covariance)):
                entry = 0.0
                for k, value in entries:
                    entry += covariance[row, k] * (rows[i, k] if value is None else value)
                cross[row, i] = entry
        for j, entries in rows_of:
            for i in range(j, len(spread)):
                entry = 0.0
                for k, value in entries:
                    entry += (rows[j, k] if value is None else value) * cross[k, i]
                spread[i, j] = spread[j, i] = entry

    return measure


def adding_through(pattern: Pattern | None) -> AddThrough:
    """Make `add(covariance, gain, variances)`, which replaces P by P + G diag(variances) G'."""
    if pattern is None:
        return add_through
    columns = [dict(entries) for entries in pattern]
    both = tuple(
        (row, column, tuple(k for k in columns[row] if k in columns[column]))
        for row in range(len(pattern))
        for column in range(row + 1)
    )
    pairs = tuple(each for each in both if each[2])

    def add(covariance: Floats, gain: Floats, variances: Floats) -> None:
        for row, column, shared in pairs:
            entry = covariance[row, column]
            for k in shared:
                entry += gain[row, k] * variances[k] * gain[column, k]
            covariance[row, column] = covariance[column, row] = entry

    return add
