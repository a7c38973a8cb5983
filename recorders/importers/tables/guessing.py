"""Guesses a mapping to start from: which messages columns are, by their names and numbers.

Every guess stands in the mapping with its reason as a comment beside it; columns that fit no message
become a vector of plain numbers. A person reads and mends it: the text is the product, not the import.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.importers.stamps import NOT_A_TIME
from recorders.importers.tables.column_streams import GUESSES, true_columns, truth_lines
from recorders.importers.tables.columns import (
    GuessedColumn,
    GuessedTable,
    names_of,
    parted,
    stream_lines,
    underlined,
)
from recorders.importers.tables.files import Batch, Table, open_table
from recorders.importers.tables.times import (
    ISO,
    TimeMapping,
    formats_of,
    offset_of,
    stamps_ns,
)

# How many rows are read.
_ROWS = 100_000
# A file without times that has fewer is a summary or a text.
_FEWEST = 10
# Units of stamps by the least that today's date is in them.
_EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8))
_UNKNOWN_ZERO = "2026-01-01"
# Names of files with the truth.
_REFERENCE = r"(?i)(^|[^a-z])(ref|reference|gt|(ground)?_?-?truth|mocap|vicon|optitrack)([^a-z]|$)"


def guess(paths: Sequence[Path]) -> str:
    """Return a mapping of tables, in TOML; raises BadInput where a file is no table."""
    files = []
    for path in paths:
        if not path.exists():
            raise BadInput(f"{path}: no such file or folder; give the tables to guess from")
        inside = sorted(path.rglob("*")) if path.is_dir() else [path]
        files += [
            (file, file.relative_to(path) if path.is_dir() else Path(file.name)) for file in inside
        ]
    tables: list[str] = []
    notes: list[str] = []
    for file, name in files:
        if file.is_file():
            try:
                tables.append(_table(file, name.as_posix(), is_alone=len(files) == 1))
            except BadInput as error:
                notes.append(str(error))
    if not tables:
        raise BadInput(
            notes[0]
            if len(notes) == 1
            else f"{paths[0]}: has no table among its files; give a folder or files of tables"
        )
    head = [
        "# What fuselog guessed; mend what is wrong: docs/your-log.md says how.",
        f"summary = {json.dumps(f'guessed from {paths[0].name}')}",
        *(f"# not taken: {note}" for note in notes),
        *_warnings("\n".join(tables)),
    ]
    return "\n".join(head) + "\n\n" + "\n".join(tables)


def _warnings(text: str) -> Iterator[str]:
    """Say what a person must still say of streams that belong together: vehicle and origin."""
    namespaces = dict.fromkeys(re.findall(r'^topic = "(/.+)/', text, re.MULTILINE))
    if len(namespaces) > 1:
        yield f"# The topics lie in {len(namespaces)} namespaces, {', '.join(namespaces)}."
        yield "# They are taken for one vehicle's while none of a kind is there twice; better give all"
        yield "# of one vehicle the same, such as /car/odometry, /car/fix and /car/truth."
    becomes = re.findall(r'^becomes = "(\w+)"', text, re.MULTILINE)
    if {"GeodeticFix", "TruthState"} <= {*becomes}:
        yield "# The truth is in a plane, fixes are latitudes and longitudes. Without where the plane"
        yield "# touches, here or as --origin LATITUDE,LONGITUDE,HEIGHT, the truth judges nothing:"
        yield "# [origin]"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
        yield "# altitude_m = "


def _table(path: Path, name: str, *, is_alone: bool) -> str:
    """Write one [[tables]] of a mapping, with its streams."""
    table, batch, decimal = _first_rows(path)
    columns, texts = [], []
    for column in table.columns:
        values = _numbers(batch[column])
        if values is None:
            texts.append(column)
        else:
            columns.append(GuessedColumn(column, *parted(column), values))
    time, used, comments = _time(path, batch, columns, texts)
    if not columns or (not used and len(columns[0].values) < _FEWEST):
        raise BadInput(
            f"{path}: has no column of times, and no column of {_FEWEST} numbers or more; write a "
            "mapping by hand, as docs/your-log.md says"
        )
    lines = ["[[tables]]", f"files = {json.dumps(name)}"]
    lines += [f'decimal = "{decimal}"'] * (decimal != ".")
    lines += [*comments, f"time = {time}"]
    if all(column.isdecimal() for column in table.columns):
        blanks = ", ".join(f'"{column}"' for column in table.columns)
        lines.append(f"# The file does not name its columns; to name them: columns = [{blanks}]")
    if not_taken := [text for text in texts if text not in used]:
        lines.append(f"# Columns with texts, not taken: {', '.join(not_taken)}")
    prefix = (
        "" if is_alone else "/" + re.sub(r"\W+", "_", Path(name).with_suffix("").as_posix()).strip("_")
    )
    left = [column for column in columns if column.name not in used]
    is_reference = re.search(_REFERENCE, path.stem) is not None
    true = GuessedTable(true_columns(left, is_reference=is_reference), prefix, True, [], [])
    rest = GuessedTable(left, prefix, bool(true.columns), [], [])
    streams = [line for guessed in GUESSES for line in guessed(rest)]
    streams += [*_rest(rest), *truth_lines(true)]
    if not any(line.startswith("topic =") for line in streams):
        raise BadInput(
            f"{path}: its name or columns say that it is the truth, and it has no position or heading; "
            "if it was measured, write a mapping by hand"
        )
    return "\n".join([*lines, *rest.made, *true.made, *streams]) + "\n"


def _first_rows(path: Path) -> tuple[Table, Batch, str]:
    """Open a table; return it, its first rows as texts, and the mark before fractions."""
    decimal = "."
    table, batch = _opened(path, decimal)
    if any(_has_commas(cells) for cells in batch.values()):
        decimal = ","
        table, batch = _opened(path, decimal)
    return table, batch, decimal


def _opened(path: Path, decimal: str) -> tuple[Table, Batch]:
    table = open_table(path, decimal=decimal)
    batch = next(table.batches((), table.columns), None)
    if batch is None:
        raise BadInput(f"{path}: has no rows")
    return table, {column: cells[:_ROWS] for column, cells in batch.items()}


def _has_commas(cells: pa.Array) -> bool:
    """Tell whether all cells are numbers, and some have a fraction after a comma."""
    if not pa.types.is_string(cells.type):
        return False
    known = pc.utf8_trim_whitespace(cells).drop_null()
    known = known.filter(pc.not_equal(known, ""))
    numbers = pc.match_substring_regex(known, r"^[-+]?\d*(,\d+)?([eE][-+]?\d+)?$")
    with_comma = pc.match_substring(known, ",")
    return bool(pc.all(numbers).as_py() and pc.any(with_comma).as_py())


def _numbers(cells: pa.Array) -> NDArray | None:
    """Read a column's numbers, NaN for empty cells; None where it holds something else, or nothing."""
    if pa.types.is_string(cells.type):
        cells = pc.utf8_trim_whitespace(cells)
    try:
        found = cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except pa.ArrowException:
        return None
    return found if np.isfinite(found).any() else None


# The time.


def _time(
    path: Path, batch: Batch, columns: Sequence[GuessedColumn], texts: Sequence[str]
) -> tuple[str, set[str], list[str]]:
    """Write the time as TOML; return also the columns that it is of, and what was seen.

    Raises BadInput where a column of texts holds times that cannot be read: no rate stands for them.
    """
    plain = {name: parted(name)[0] for name in texts}
    days = [name for name in texts if re.fullmatch("(.*_)?(date|day)", plain[name])]
    hours = [name for name in texts if re.fullmatch("(.*_)?(time|clock|utc)", plain[name])]
    pairs = [[day, hour] for day in days for hour in hours]
    for names in (*pairs, *([name] for name in texts)):
        if found := _dated(batch, names):
            return found
    for name in texts:
        cell = _first_cell(batch[name])
        if re.search(r"\d{1,2}:\d{2}|\d{1,4}[./-]\d{1,2}[./-]\d{1,4}", cell):
            raise BadInput(
                f"{path}: column {name} holds times such as '{cell}', whose format is not known; write "
                f'a mapping by hand, with time = {{ column = "{name}", unit = "date", format = ... }}, '
                "as docs/your-log.md says"
            )
    named = [column for column in columns if re.search("time|stamp|utc|^t$|^sec", column.plain)]
    first = [columns[0]] if columns else []
    for column in (*named, *first):
        known = column.values[np.isfinite(column.values)]
        if len(known) < 2 or np.mean(np.diff(known) >= 0) < 0.9 or known[-1] <= known[0]:
            continue
        middle, step = float(np.median(known)), float(np.median(np.diff(known)))
        epoch = next((name for name, least in _EPOCHS if middle >= least), None)
        relative = "ns" if step > 1e5 else "us" if step > 1e3 else "ms" if step >= 1 else "s"
        in_unit = column.unit if column.unit in dict(_EPOCHS) else epoch or relative
        comments = []
        if epoch is None:
            comments = [
                f"# Stamps begin at {known[0]:g}: give the date that they count from; check the unit."
            ]
        zero = f', zero = "{_UNKNOWN_ZERO}"' if epoch is None else ""
        given = {"column": column.name, "unit": in_unit, "zero": _UNKNOWN_ZERO}
        mapping = TimeMapping.model_validate(given)
        text = f'{{ column = {json.dumps(column.name)}, unit = "{in_unit}"{zero} }}'
        return text, {column.name}, [*comments, *_seen(mapping, batch)]
    return (
        '{ rate_hz = 1, zero = "2026-01-01" }',
        set(),
        ["# No column looks like a time: give the rate of the rows."],
    )


def _first_cell(cells: pa.Array) -> str:
    texts = pc.utf8_trim_whitespace(cells.cast(pa.string()))
    return next((text for text in texts.to_pylist() if text), "")


def _dated(batch: Batch, names: Sequence[str]) -> tuple[str, set[str], list[str]] | None:
    """Write the time of columns of texts as TOML, as `_time` does; None where they hold none."""
    cell = " ".join(_first_cell(batch[name]) for name in names)
    is_of_day = re.match(r"\d{1,2}:\d{2}", cell) is not None
    given: dict[str, Any] = {"column": list(names), "unit": "date"}
    comments = ['# If its clock is not UTC: zone = "Europe/Berlin", or utc_offset_h = 8.']
    if zone := _zone(names):
        given["zone"], comments = zone, []
    if is_of_day:
        given["zero"] = _UNKNOWN_ZERO
        comments.append("# These times have no date: give the day in zero.")
    fitting = {}
    for pattern in formats_of(cell):
        mapping = TimeMapping.model_validate({**given, "format": pattern})
        if seen := _seen(mapping, batch):
            fitting[pattern] = seen
    if not fitting:
        return None
    (pattern, seen), *others = fitting.items()
    if others:
        comments.append(f"# Day and month may be exchanged: {others[0][0]} fits as well.")
    if pattern != ISO:
        given["format"] = pattern
    given["column"] = names[0] if len(names) == 1 else list(names)
    parts = [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in given.items()]
    return f"{{ {', '.join(parts)} }}", set(names), [*seen, *comments]


def _zone(names: Sequence[str]) -> str:
    """Return the zone that a column's name states in brackets."""
    for text in re.findall(r"[\[(]\s*([^\])]+?)\s*[\])]", " ".join(names)):
        try:
            offset_of(text)
        except ValueError:
            continue
        return str(text)
    return ""


def _seen(mapping: TimeMapping, batch: Batch) -> list[str]:
    """Say the rate, gaps and repetitions of stamps; nothing where they cannot be read."""
    try:
        stamps = stamps_ns(mapping, batch, 0, len(next(iter(batch.values()))), "")
    except BadInput:
        return []
    steps_s = np.diff(stamps[stamps != NOT_A_TIME]) * 1e-9
    forward = steps_s[steps_s > 0]
    if not len(forward):
        return ["# All rows have one stamp."]
    usual_s = float(np.median(forward))
    gaps = forward[forward > 5 * usual_s]
    rate = f"{1 / usual_s:.4g}"
    comment = f"# {rate} {'row' if rate == '1' else 'rows'} a second"
    if len(gaps):
        what = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        comment += f"; {what} over {5 * usual_s:.3g} s, the longest {gaps.max():.3g} s"
    for one, many, which in (
        ("repeats", "repeat", steps_s == 0),
        ("goes back", "go back", steps_s < 0),
    ):
        if which.any():
            comment += f"; 1 stamp {one}" if which.sum() == 1 else f"; {which.sum()} stamps {many}"
    return [f"{comment}."]


# What columns are together.


def _rest(table: GuessedTable) -> list[str]:
    """Say which columns fit no message."""
    if not table.columns:
        return []
    plain = [
        name if re.match("[a-z]", name) else f"column_{name}"
        for name in (underlined(column.name) for column in table.columns)
    ]
    counts = Counter(plain)
    names = [name if counts[name] == 1 else f"{name}_{number}" for number, name in enumerate(plain, 1)]
    return stream_lines(
        f"{table.prefix}/values",
        "VectorMeasurement",
        "the names fit no other message",
        f"fields.value = {names_of(table.columns)}",
        f'components = "{",".join(names)}"',
    )
