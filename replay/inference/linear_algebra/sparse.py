"""Propagates covariances through matrices whose zeros and ones are known in advance.

A `Pattern` has for each row of a matrix its entries that may differ from zero: the column, and the entry
itself where it is known. What is left out are products with zero: sums keep their order.
"""

from collections.abc import Mapping
from typing import Any

from replay.engine.arrays import Floats, Function
from replay.inference.linear_algebra.gaussian import (
    add_through,
    measured_covariance,
    propagate_covariance,
)

Pattern = tuple[tuple[tuple[int, float | None], ...], ...]


def pattern_of(known: Mapping[tuple[int, int], float | None] | None, rows: int) -> Pattern | None:
    """Make the pattern of a matrix of so many rows from its entries by place (None where one varies)."""
    if known is None:
        return None
    return tuple(
        tuple((column, value) for (at, column), value in sorted(known.items()) if at == row)
        for row in range(rows)
    )


def propagating_covariance(pattern: Pattern | None) -> Function:
    """Make `move(covariance, transition, product)`: P (t, t) becomes F P F'; `product` becomes F P."""
    if pattern is None:
        return propagate_covariance
    rows = tuple(enumerate(pattern))

    def move(covariance: Floats, transition: Floats, product: Floats) -> None:
        size = len(covariance)
        for row, entries in rows:
            for column in range(size):
                entry = 0.0
                for k, value in entries:
                    factor = transition[row, k] if value is None else value
                    entry += factor * covariance[k, column]
                product[row, column] = entry
        for column, entries in rows:
            for row in range(column, size):
                entry = 0.0
                for k, value in entries:
                    factor = transition[column, k] if value is None else value
                    entry += product[row, k] * factor
                covariance[row, column] = covariance[column, row] = entry

    return move


def measuring_covariance(pattern: Pattern | None) -> Function:
    """`measure(covariance, rows, cross, spread)`: C = P H' and S = H C, with H in `rows`."""
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


def adding_through(pattern: Pattern | None) -> Function:
    """Make `add(covariance, gain, variances)`: P becomes P + G diag(variances) G'."""
    if pattern is None:
        return add_through
    columns: list[dict[int, Any]] = [dict(entries) for entries in pattern]
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
