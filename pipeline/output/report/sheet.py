"""The table of metrics: a column per estimator, a dozen visible rows, and further rows folded below."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

import pandas as pd

from fuselog.pipeline.output.report.evidence import MARGIN, Findings
from fuselog.pipeline.output.report.story import choice_of
from fuselog.pipeline.output.results import Measured, MetricTable
from fuselog.pipeline.output.terminal import over_cases
from fuselog.pipeline.output.words import (
    ACCURACY,
    CONSISTENCY,
    COST,
    MISSING,
    OTHER,
    QUANTITIES,
    TRACKING,
    Scale,
    interval,
    number,
    quantity,
    scale,
)
from fuselog.replay.judging.errors.differences import target_of
from fuselog.replay.judging.intervals import Interval, mean_interval, rms_interval
from fuselog.replay.judging.verdicts import Consistency, Squares

MOST_ROWS = 12
GROUPS = (ACCURACY, TRACKING, CONSISTENCY, COST, OTHER)


class Cell(NamedTuple):
    """A number in a table, with a note in small print, and whether it is the best or out of bounds."""

    text: str
    small: str = ""
    look: str = ""


@dataclass(frozen=True)
class Row:
    """One quantity for all estimators; `key` is its name in the result."""

    key: str
    name: str
    meaning: str
    unit: str
    aim: str
    cells: list[Cell]


@dataclass(frozen=True)
class Sheet:
    """A table: groups of rows, and further rows that are folded below."""

    title: str
    columns: list[str]
    groups: dict[str, list[Row]]
    more: list[Row] = field(default_factory=list)

    @property
    def has_missing(self) -> bool:
        """Test whether a cell has no value."""
        rows = [row for of in (*self.groups.values(), self.more) for row in of]
        return any(cell.text == MISSING for row in rows for cell in row.cells)


def sheets(found: Findings) -> tuple[Sheet | None, list[Sheet]]:
    """Make the table of a result, and one for each of several cases; (None, []) if it has no numbers.

    The recommended estimator is in the first column, which is visible even if the table is wider
    than the page.
    """
    take, _ = choice_of(found)
    columns = list(dict.fromkeys([*filter(None, [take]), *found.labels, *found.bounds]))
    tables = [table for table in found.tables if any(table.quantities.values())]
    if not tables or not columns:
        return None, []
    if len(tables) == 1:
        return _sheet(found, tables[0], columns, ""), []
    medians = _medians(tables)
    title = f"Median of {len(tables)} cases, with the range from minimum to maximum"
    each = [_sheet(found, table, columns, table.case or "all") for table in tables]
    return _sheet(found, medians, columns, title, spreads=_spreads(tables)), each


def table_of_pairs(found: Findings) -> pd.DataFrame:
    """Tabulate differences by pair of estimators and quantity, with a column per case."""
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for each in found.pairs:
        words = quantity(each.quantity.removeprefix("change_in_"))
        own = scale(words.unit, each.more.value)
        ends = f" ({interval(each.more.low, each.more.high, own)})" if each.more.is_bounded else ""
        of = rows.setdefault((each.first, each.second, words.name), {})
        of[each.case or "all"] = f"{own.text(each.more.value)}{ends} {own.sign}".rstrip()
    about = ("estimator", "has more than", "of")
    return pd.DataFrame([dict(zip(about, what, strict=True)) | of for what, of in rows.items()])


def _medians(tables: list[MetricTable]) -> MetricTable:
    """Compute the median over the cases that have a value."""
    quantities: dict[str, dict[str, Measured]] = {}
    for key, of in over_cases(tables).items():
        quantities[key] = {label: Measured(float(median(values))) for label, values in of.items()}
    return MetricTable("", tables[0].estimators, quantities)


def _spreads(tables: list[MetricTable]) -> dict[str, dict[str, tuple[float, float]]]:
    return {
        key: {label: (min(values), max(values)) for label, values in of.items()}
        for key, of in over_cases(tables).items()
    }


def _sheet(
    found: Findings,
    table: MetricTable,
    columns: list[str],
    title: str,
    spreads: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
) -> Sheet:
    order = list(QUANTITIES)
    keys = [key for key, values in table.quantities.items() if values and key != "over_ensemble"]
    known = sorted((key for key in keys if key in QUANTITIES), key=order.index)
    first = [*known, *(key for key in keys if key not in QUANTITIES and "rmse" in key)][:MOST_ROWS]
    first = first or keys[:MOST_ROWS]
    rows = {key: _row(found, table, key, columns, spreads) for key in keys}
    groups = {group: [rows[key] for key in first if quantity(key).group == group] for group in GROUPS}
    more = [rows[key] for key in keys if key not in first]
    return Sheet(title, columns, {group: of for group, of in groups.items() if of}, more)


def _row(
    found: Findings,
    table: MetricTable,
    key: str,
    columns: list[str],
    spreads: Mapping[str, Mapping[str, tuple[float, float]]] | None,
) -> Row:
    words, values = quantity(key), table.quantities[key]
    of = {label: values[label] for label in columns if label in values}
    numbers = {
        label: float(each.value) for label, each in of.items() if isinstance(each.value, int | float)
    }
    own = scale(words.unit, *numbers.values())
    best = _best(key, numbers, words.aim) if len(columns) > 1 else set()
    aim = _aim(found, key) or words.aim
    cells = []
    for label in columns:
        each = of.get(label, Measured())
        if label not in numbers:
            cells.append(Cell(str(each.value) if isinstance(each.value, str) else MISSING))
            continue
        if spreads is None:
            small = _interval(found, key, label, own)
        else:
            low, high = spreads[key][label]
            small = interval(low, high, own) if low < high else ""
        is_out = _is_out(found, key, each)
        cells.append(
            Cell(own.text(numbers[label]), small, "out" if is_out else "best" if label in best else "")
        )
    return Row(key, words.name, words.meaning, own.sign, aim, cells)


def _is_out(found: Findings, key: str, each: Measured) -> bool:
    """Test whether a NEES or NIS is outside the bounds of a consistent estimator, if it has bounds."""
    if each.bounds is None or not isinstance(each.value, int | float):
        return False
    aim = 1.0 if key == "nis_per_component" else found.size_of(each.bounds)
    squares = Squares(key, Interval(float(each.value)), aim, each.bounds)
    return squares.verdict != Consistency.CONSISTENT


def _interval(found: Findings, key: str, label: str, own: Scale) -> str:
    """Write the 95 % interval of a value over runs, if the result has a table of runs."""
    stem = key.replace("_rmse", "")
    column = key if key in found.rows else f"rmse_{stem}"
    if quantity(key).group not in (ACCURACY, CONSISTENCY) or column not in found.rows:
        return ""
    values = found.by_run(label, column).to_numpy(dtype=float)
    found_in = (rms_interval if "rmse" in column else mean_interval)(values)
    return interval(found_in.low, found_in.high, own) if found_in.is_bounded else ""


def _aim(found: Findings, key: str) -> str:
    """Write the ideal NEES, if all estimators have the same number of components."""
    squares = [by for each in found.of.values() for by in each.squares]
    sizes = {number(by.aim) for by in squares if by.name == "NEES"}
    return next(iter(sizes)) if key == "nees" and len(sizes) == 1 else ""


def _best(key: str, numbers: Mapping[str, float], aim: str) -> set[str]:
    """Find the estimators whose value is the best, or within the margin of the best."""
    target = target_of(key) or ("low" if quantity(key).group == ACCURACY else None)
    finite = {label: value for label, value in numbers.items() if math.isfinite(value)}
    if target not in ("low", "high") or len(finite) < 2 or len({*finite.values()}) == 1 or aim:
        return set()
    best = min(finite.values()) if target == "low" else max(finite.values())
    allowed = MARGIN * abs(best) if key != "log_likelihood" else 2.0
    return {label for label, value in finite.items() if abs(value - best) <= allowed}
