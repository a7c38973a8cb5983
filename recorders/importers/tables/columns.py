"""Takes the columns of a table by their names, axes, units and sizes."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.importers.units import unit


class GuessedColumn(NamedTuple):
    """A column: its name, that without its unit in lower case, the unit, and its numbers (rows,)."""

    name: str
    plain: str
    unit: str
    values: NDArray


class GuessedTable(NamedTuple):
    """The columns that no stream has yet, how topics begin, and whether the file's name says truth."""

    columns: list[GuessedColumn]
    prefix: str
    is_reference: bool


def take(columns: list[GuessedColumn], *patterns: str) -> list[GuessedColumn]:
    """The columns whose names fit the patterns, one each, taken out of the list; none unless all do."""
    found = []
    for pattern in patterns:
        match = next((each for each in columns if re.fullmatch(pattern, each.plain)), None)
        if match is None:
            return []
        found.append(match)
    columns[:] = [each for each in columns if each not in found]
    return found


def take_axes(columns: list[GuessedColumn], *stems: str, axes: str = "xyz") -> list[GuessedColumn]:
    """The columns of the axes of a vector whose name is one of some."""
    for stem in stems:
        before = f"(.*_)?{stem}_?" if stem else ""
        if found := take(columns, *(before + axis for axis in axes)):
            return found
    return []


def stated_unit(column: GuessedColumn, usual: str) -> str:
    """The unit that a column's name states, if it is one of the usual one's kind."""
    return column.unit if column.unit and unit(column.unit).powers == unit(usual).powers else ""


def unit_by_size(
    columns: Sequence[GuessedColumn], sizes: Mapping[str, tuple[float, float]]
) -> tuple[str, str]:
    """The unit in which a vector's length is as it must be, else the first; and the reason."""
    usual = next(iter(sizes))
    if stated := stated_unit(columns[0], usual):
        return stated, "as its name says"
    length = length_of(columns)
    for name, (low, high) in sizes.items():
        if low <= length <= high:
            return name, f"its median length is {length:.4g}"
    return usual, f"a guess: its median length is {length:.4g}"


def length_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the median length of the vectors of some columns."""
    return float(np.nanmedian(np.linalg.norm([column.values for column in columns], axis=0)))


def unit_by_largest(column: GuessedColumn, usual: str, other: str, limit: float) -> tuple[str, str]:
    """The unit of a column: the other one if its numbers go beyond a limit; and the reason."""
    if stated := stated_unit(column, usual):
        return stated, "as its name says"
    largest = largest_of([column])
    return (other if largest > limit else usual), f"the largest is {largest:.4g}"


def largest_of(columns: Sequence[GuessedColumn]) -> float:
    """Return the largest magnitude among some columns."""
    return float(np.nanmax(np.abs([column.values for column in columns])))


def stream_lines(topic: str, becomes: str, why: str, *lines: str) -> list[str]:
    """Write one stream of a mapping: its topic, what it becomes and why, and further lines."""
    head = ["", f"# {becomes}: {why}.", "[[tables.streams]]"]
    return [*head, f'topic = "{topic}"', f'becomes = "{becomes}"', *lines]


def names_of(columns: Sequence[GuessedColumn]) -> str:
    """Write the names of columns as a list of TOML."""
    return json.dumps([column.name for column in columns], ensure_ascii=False)


def name_of(column: GuessedColumn) -> str:
    """Write the name of a column as TOML."""
    return json.dumps(column.name, ensure_ascii=False)
