"""Guesses of a first mapping: names and numbers of columns show which messages they contain.

The mapping gives the reason for each guess in a comment; columns that fit no message become a vector of
plain numbers. The result is text, not an import, so that a person can read and correct the mapping.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import NOT_A_TIME, Stamps
from fuselog.recorders.importers.tables.blocks import COMMENTS, lines_of
from fuselog.recorders.importers.tables.cells import sided
from fuselog.recorders.importers.tables.column_streams import GUESSES, true_columns, truth_lines
from fuselog.recorders.importers.tables.columns import (
    ASSUMED,
    GuessedColumn,
    GuessedTable,
    bracketed,
    known_of,
    names_of,
    parted,
    stream_lines,
    underlined,
    unit_in,
)
from fuselog.recorders.importers.tables.files import (
    VBOX_UNITS,
    Batch,
    Table,
    TextOptions,
    floats,
    open_table,
    open_text,
    texts_in,
)
from fuselog.recorders.importers.tables.guessed_places import prepared_lines, without_codes
from fuselog.recorders.importers.tables.guessed_times import GuessedTime, first_cell, guess_time
from fuselog.recorders.log import Schema, schemas

# How many rows are read.
_ROWS = 100_000
# A file without times and with fewer rows is a summary or a text.
_FEWEST = 10
# Names of files with the truth.
_REFERENCE = r"(?i)(^|[^a-z])(ref|reference|gt|(ground)?_?-?truth|mocap|vicon|optitrack)([^a-z]|$)"
# Sensors whose axes are the columns x, y and z of a file with such a name.
_SENSORS = {
    "acc": r"(?i)acc(el\w*)?(?![a-z])|acceleration", "gyr": r"(?i)gyro\w*|gyr(?![a-z])",
    "mag": r"(?i)mag(netometer|netic\w*)?(?![a-z])", "gravity": "(?i)gravity",
}  # fmt: skip
# Value columns with a general name, and columns that name the quantity of each row.
_KINDS = {
    r"_?(value|val|reading)(_1)?": r"_?(field|name|signal|variable|parameter|metric|key|topic)(_1)?"
    r"|(.*_)?(sensor|channel|measurement)(_?(name|type))?",
    "x": r"(.*_)?sensor(_?(name|type))?",
}
# Names of files with axes north, east, down, as in PX4 and MAVLink, and frames in names.
_NED = r"(?i)vehicle_(local_position|odometry|trajectory)|local_position_ned|(^|[^a-z])ned([^a-z]|$)"
_FRAME = r"(^|_)(ned|enu)(?=_|$)"
# Names of columns with latitudes or longitudes.
_PLACE = r"(^|_)(lat(itude)?|lon|lng|long(itude)?)$"
# Texts in place of a unit that need no comment.
_NO_UNITS = {"", "-", "1", "none", "n/a"}
# The column name for times in a file of their own.
_STAMP = "timestamp"
# The beginning of the line on a file that is left out.
_NOT_TAKEN = "# not taken: "
# Reasons of a guess that leave no doubt.
_SURE = ("as its name says", "which agrees with the positions")

# The smallest number of one-row files that are treated as one table.
_FEWEST_ROWS = 3
_TEXTS = {".txt", ".csv", ".tsv", ".dat"}

# The counter of Xsens, and the sample rates at which it is in us, as in a DOT; otherwise it is in 0.1
# ms.
_XSENS, _DOT_RATES_HZ = "SampleTimeFine", np.array([1, 4, 10, 12, 15, 20, 30, 60, 120])
# Names of columns in tables of a VBOX.
_VBOX = (
    {"sats", "time", "lat", "long", "velocity", "heading", "height"},
    {"satellites", "time", "latitude", "longitude", "velocity", "heading", "height"},
)
# An inertial unit of ArduPilot, with axes forward, right, down.
_ARDUPILOT = ("TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
# The largest latitude in deg, and in minutes.
_LARGEST_LATITUDE = (90.0, 5400.0)

_CLOCKS = ("publish_time_ns", "log_time_ns", "sensor_time_ns")
_NAMED_VECTORS = ("value", "state", "mean")


class Source(NamedTuple):
    """The files of one table.

    Attributes:
        path: the first file.
        name: pattern of the names of all files.
        more: the files whose rows follow those of `path`.
        stamps: the file with the times of the rows, and its name relative to the folder.
        columns: names of the columns, if another file lists them.
    """

    path: Path
    name: str
    more: tuple[Path, ...] = ()
    stamps: tuple[Path, str] | None = None
    columns: tuple[str, ...] = ()


def sources_of(files: Sequence[tuple[Path, str]]) -> list[Source]:
    """Group files, given with their names, into tables; the one-row files of a folder are one table."""
    groups: dict[tuple[Path, str], list[tuple[Path, str]]] = {}
    for path, name in files:
        if path.suffix.lower() in _TEXTS and re.fullmatch(r"\D*\d+", path.stem):
            groups.setdefault((path.parent, path.suffix), []).append((path, name))
    joined = []
    taken: set[Path] = set()
    for (_, suffix), group in groups.items():
        if len(group) < _FEWEST_ROWS or any(_count(path, 2) != 1 for path, _ in (group[0], group[-1])):
            continue
        others = [each for each in files if each not in group and each[0].suffix.lower() in _TEXTS]
        stamps = next((each for each in others if _count(each[0], len(group) + 1) == len(group)), None)
        columns, said_by = _columns(group[0][0], [path for path, _ in others])
        taken |= {path for path, _ in group} | ({stamps[0]} if stamps else set()) | said_by
        folder = group[0][1].rpartition("/")[0]
        pattern = f"{folder}/*{suffix}" if folder else f"*{suffix}"
        more = tuple(path for path, _ in group[1:])
        joined.append(Source(group[0][0], pattern, more, stamps, columns))
    return [*joined, *(Source(path, name) for path, name in files if path not in taken)]


def _count(path: Path, most: int) -> int:
    """Count the rows of a text, up to `most`; return 0 if it cannot be read."""
    try:
        with open_text(path) as file:
            rows = (line for line in lines_of(file) if line.strip() and not line.startswith(COMMENTS))
            return sum(1 for _ in islice(rows, most))
    except (OSError, ValueError):
        return 0


def _columns(first: Path, others: Sequence[Path]) -> tuple[tuple[str, ...], set[Path]]:
    """Find a file that lists columns as lines `name: meaning`; return the names and the file."""
    width = len(next(texts_in(first)).replace(",", " ").split())
    for path in others:
        try:
            named = [
                re.match(r"\s*([A-Za-z]\w*)\s*:", line) for line in islice(texts_in(path), width + 1)
            ]
        except (OSError, ValueError, BadInput):
            continue
        if len(named) == width and all(named):
            return tuple(each[1] for each in named if each), {path}
    return (), set()


def guess(paths: Sequence[Path]) -> str:
    """Write a mapping of tables in TOML; raise BadInput if no file is a table."""
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
    sources = sources_of([(file, name.as_posix()) for file, name in files if file.is_file()])
    for source in sources:
        try:
            tables.append(_table(source, is_alone=len(sources) == 1))
        except BadInput as error:
            notes.append(str(error))
    if not tables:
        raise BadInput(
            notes[0]
            if len(notes) == 1
            else f"{paths[0]}: has no table among its files; give a folder or files of tables"
        )
    head = [
        "# Guessed by fuselog; correct it where needed: docs/your-log.md explains how.",
        f"summary = {json.dumps(f'guessed from {paths[0].name}')}",
        *(f"{_NOT_TAKEN}{note}" for note in notes),
        *_warnings("\n".join(tables)),
    ]
    return "\n".join(head) + "\n\n" + "\n".join(tables)


def assumptions(text: str) -> list[str]:
    """List the assumptions of a guessed mapping that change numbers, and the files it leaves out."""
    found = []
    for line in text.splitlines():
        setting, _, why = line.partition("   # ")
        if line.startswith(ASSUMED):
            found.append(f"assumed: {line.removeprefix(ASSUMED)}")
        elif line.startswith(_NOT_TAKEN):
            found.append(line.removeprefix("# "))
        elif why and why not in _SURE:
            found.append(f"assumed: {setting} ({why})")
    return list(dict.fromkeys(found))


def _warnings(text: str) -> Iterator[str]:
    """Write what the user still has to state for streams that belong together: vehicle and origin."""
    namespaces = dict.fromkeys(re.findall(r'^topic = "(/.+)/', text, re.MULTILINE))
    if len(namespaces) > 1:
        yield f"# The topics are in {len(namespaces)} namespaces, {', '.join(namespaces)}."
        yield "# They are treated as those of one vehicle unless a kind of topic occurs twice. Better"
        yield "# use one namespace for a vehicle, as in /car/odometry, /car/fix and /car/truth."
    becomes = re.findall(r'^becomes = "(\w+)"', text, re.MULTILINE)
    if {"GeodeticFix", "TruthState"} <= {*becomes}:
        yield "# The truth is in a local tangent plane, but fixes are latitudes and longitudes."
        yield "# The truth is not used unless the plane's origin is given, here or with --origin:"
        yield "# [origin]"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
        yield "# altitude_m = "


def _table(source: Source, *, is_alone: bool) -> str:
    """Write one [[tables]] of a mapping, with its streams."""
    path, name = source.path, source.name
    table, batch, decimal, split = _first_rows(source)
    columns, texts, with_side = [], [], []
    for column in table.columns:
        values = _numbers(batch[column])
        if values is None and (values := _sided(column, batch[column])) is not None:
            with_side.append(column)
        if values is None:
            texts.append(column)
        else:
            plain, unit = parted(column)
            below = table.units.get(column, "")
            unit = unit_in(below) or unit
            inside = bracketed(column)
            unknown = "" if unit else below or (inside[1] if inside else "")
            columns.append(GuessedColumn(column, plain, unit, values, unknown))
    _check_kinds(path, table.columns, batch)
    columns = of_device(_in_frame(_without_denied(_of_sensor(columns, path)), path))
    exported = export_mapping(path, table.columns, batch)
    time = None if exported else _time(source, batch, columns, texts, has_others=not is_alone)
    used = time.used if time else set()
    is_timed = bool(used or exported or source.stamps)
    unread = [
        f"column {text} holds places such as '{found}', which are not numbers; convert them to degrees"
        for text in texts
        if re.search(_PLACE, parted(text)[0])
        and (
            found := next((cell for cell in batch[text].to_pylist() if re.search(r"\d", cell or "")), "")
        )
    ]
    if unread and not columns:
        raise BadInput(f"{path}: {unread[0]}")
    if not columns or (not is_timed and len(columns[0].values) < _FEWEST):
        raise BadInput(
            f"{path}: has no column of times, and no column of {_FEWEST} numbers or more; write a "
            "mapping yourself, as docs/your-log.md explains"
        )
    lines = ["[[tables]]", f"files = {json.dumps(name)}"]
    if exported:
        return "\n".join([*lines, *exported]) + "\n"
    assert time is not None
    lines += [f'decimal = "{decimal}"'] * (decimal != ".")
    if source.more:
        lines += ["joined = true", *[f"columns = {json.dumps(source.columns)}"] * bool(source.columns)]
    if split:
        parts = [f"{json.dumps(source)} = {json.dumps(names)}" for source, names in split.items()]
        lines.append(f"split = {{ {', '.join(parts)} }}")
        lines += [
            f"{ASSUMED}{source}: {' and '.join(names)} in one cell, in this order; split"
            for source, names in split.items()
        ]
    lines += [*time.comments, f"time = {time.text}"]
    if all(column.isdecimal() for column in table.columns):
        blanks = ", ".join(f'"{column}"' for column in table.columns)
        lines.append(f"# The file does not name its columns; to name them: columns = [{blanks}]")
    prefix = (
        "" if is_alone else "/" + re.sub(r"\W+", "_", Path(name).with_suffix("").as_posix()).strip("_")
    )
    if time.vehicle:
        lines.append(f"vehicle = {json.dumps(time.vehicle, ensure_ascii=False)}")
        prefix += "/{vehicle}"
    used |= {time.vehicle}
    left = [column for column in columns if column.name not in used]
    is_reference = re.search(_REFERENCE, path.stem) is not None
    cells = {text: batch[text].cast(pa.string()).fill_null("").to_pylist() for text in texts}
    every = GuessedTable(
        path,
        left,
        {text: cells[text] for text in texts if text not in used},
        prefix,
        False,
        None if time.stamps is None else _seconds(time.stamps),
        list(left),
        [],
        [],
        {"hemispheres": {column: column for column in with_side}} if with_side else {},
    )
    every = _in_order(without_codes(every), batch, time.vehicle)
    of_truth = true_columns(every.columns, is_reference=is_reference)
    true = every._replace(columns=of_truth, has_truth=True, places=[], made=[])
    rest = every._replace(has_truth=bool(of_truth))
    streams = [line for guessed in GUESSES for line in guessed(rest)]
    plain_numbers = [column.name for column in rest.columns]
    streams += [*_rest(rest), *truth_lines(true)]
    rest.made.extend(_unknown_units([each for each in every.whole if each.name not in plain_numbers]))
    if not streams:
        nothing = "has no column of numbers except its time; write a mapping yourself"
        raise BadInput(f"{path}: {unread[0] if unread else nothing}")
    if not any(line.startswith("topic =") for line in streams) and rest.has_truth:
        raise BadInput(
            f"{path}: its name or columns mark it as the truth, but it has no position or heading; if "
            "it was measured, write a mapping yourself"
        )
    lines += [f"{_NOT_TAKEN}{path}: {each}" for each in unread]
    prepared = list(prepared_lines(rest))
    sides = rest.prepared.get("hemispheres", {}).values()
    if not_taken := [text for text in texts if text not in used and text not in sides]:
        lines.append(f"# Columns with texts that are not imported: {', '.join(not_taken)}")
    return "\n".join([*lines, *prepared, *rest.made, *true.made, *streams]) + "\n"


def _check_kinds(path: Path, columns: Sequence[str], batch: Batch) -> None:
    """Raise BadInput for a table with several kinds of rows, which a column of texts names."""
    plain = {name: parted(name)[0] for name in columns}
    for of_value, of_kind in _KINDS.items():
        value = next((name for name in columns if re.fullmatch(of_value, plain[name])), "")
        for name in columns if value else ():
            cells = batch[name]
            if not (re.fullmatch(of_kind, plain[name]) and pa.types.is_string(cells.type)):
                continue
            if name == "Field 1" or (_numbers(cells) is None and pc.count_distinct(cells).as_py() > 1):
                raise BadInput(
                    f"{path}: holds messages of several kinds, as column {name} says, with numbers in "
                    f"{value}; give a table with a column for each, such as the NAME_data.csv that "
                    "FitCSVTool writes with --data record"
                )


def _unknown_units(columns: Sequence[GuessedColumn]) -> Iterator[str]:
    """Write which columns state an unknown unit."""
    unknown: dict[str, list[str]] = {}
    for column in columns:
        if column.unknown.lower() not in _NO_UNITS:
            unknown.setdefault(column.unknown, []).append(column.name)
    for text, names in unknown.items():
        yield f"{ASSUMED}{', '.join(names)}: '{text}' is not a known unit, so it is ignored; units"


def _of_sensor(columns: list[GuessedColumn], path: Path) -> list[GuessedColumn]:
    """Prefix the columns x, y, z with the sensor that the file's name states."""
    sensor = next((name for name, known in _SENSORS.items() if re.search(known, path.stem)), "")
    if not sensor or not {"x", "y", "z"} <= {column.plain for column in columns}:
        return columns
    return [
        column._replace(plain=f"{sensor}_{column.plain}") if column.plain in ("x", "y", "z") else column
        for column in columns
    ]


def _in_frame(columns: list[GuessedColumn], path: Path) -> list[GuessedColumn]:
    """Set the frames that the names of the columns or of the file state."""
    of_file = "ned" if re.search(_NED, path.stem) else ""
    found = []
    for column in columns:
        own = re.search(_FRAME, column.plain)
        plain = re.sub(_FRAME, "", column.plain).strip("_")
        found.append(column._replace(plain=plain, frame=own[2] if own else of_file))
    return found


def _without_denied(columns: list[GuessedColumn]) -> list[GuessedColumn]:
    """Remove columns whose covariance is marked as unknown, by -1 in its first entry, as in ROS."""
    stems = [
        stem[1]
        for column in columns
        if (stem := re.fullmatch("(.*)_covariance_?0", column.plain)) and np.all(column.values == -1)
    ]
    return [
        column
        for column in columns
        if not any(re.fullmatch(f"{re.escape(stem)}_[wxyz]", column.plain) for stem in stems)
    ]


def _time(
    source: Source,
    batch: Batch,
    columns: Sequence[GuessedColumn],
    texts: Sequence[str],
    *,
    has_others: bool,
) -> GuessedTime:
    """Guess the rows' time, which may be in a separate file."""
    if source.stamps is None:
        return guess_time(source.path, batch, columns, texts, has_others=has_others)
    path, name = source.stamps
    cells = pa.array(islice(texts_in(path), len(next(iter(batch.values())))), pa.string())
    values = _numbers(cells)
    own = [] if values is None else [GuessedColumn(_STAMP, _STAMP, "", values)]
    found = guess_time(path, {_STAMP: cells}, own, [] if own else [_STAMP])
    text = found.text.replace(f'column = "{_STAMP}"', f"file = {json.dumps(name)}")
    return found._replace(text=text, used=set())


def _in_order(table: GuessedTable, batch: Batch, vehicle: str) -> GuessedTable:
    """Sort the rows by time; if there are several vehicles, keep only the one with the most rows."""
    rows = np.arange(len(next(iter(batch.values()))))
    if vehicle:
        names = np.array(batch[vehicle].cast(pa.string()).fill_null("").to_pylist())
        values, counts = np.unique(names[names != ""], return_counts=True)
        rows = np.flatnonzero(names == values[np.argmax(counts)])
    if table.time_s is not None:
        rows = rows[np.argsort(table.time_s[rows], kind="stable")]

    def chosen(columns: list[GuessedColumn]) -> list[GuessedColumn]:
        return [column._replace(values=column.values[rows]) for column in columns]

    return table._replace(
        columns=chosen(table.columns),
        whole=chosen(table.whole),
        texts={name: [cells[row] for row in rows.tolist()] for name, cells in table.texts.items()},
        time_s=None if table.time_s is None else table.time_s[rows],
    )


def _seconds(stamps: Stamps) -> NDArray:
    known = stamps != NOT_A_TIME
    since = np.where(known, stamps - stamps[known].min(), 0) * 1e-9
    return np.where(known, since, np.nan)


def _first_rows(source: Source) -> tuple[Table, Batch, str, dict[str, list[str]]]:
    """Open a table; return it, its first rows as texts, the decimal mark, and the columns to split."""
    decimal = "."
    table, batch = _opened(source, decimal, {})
    if any(_has_commas(cells) for cells in batch.values()):
        decimal = ","
        table, batch = _opened(source, decimal, {})
    split = {name: names for name in table.columns if (names := _split(name, batch[name]))}
    if split:
        table, batch = _opened(source, decimal, split)
    return table, batch, decimal, split


def _opened(source: Source, decimal: str, split: dict[str, list[str]]) -> tuple[Table, Batch]:
    options = TextOptions(source.columns, decimal=decimal)
    table = open_table(source.path, options=options, more=source.more, split=split)
    batch = next(table.batches((), table.columns), None)
    if batch is None:
        raise BadInput(f"{source.path}: has no rows")
    return table, {column: cells[:_ROWS] for column, cells in batch.items()}


def _has_commas(cells: pa.Array) -> bool:
    """Test whether all cells are numbers, and some have a decimal comma."""
    if not pa.types.is_string(cells.type) or not pc.any(pc.match_substring(cells, ",")).as_py():
        return False
    known = pc.utf8_trim_whitespace(cells).drop_null()
    known = known.filter(pc.not_equal(known, ""))
    numbers = pc.match_substring_regex(known, r"^[-+]?\d*(,\d+)?([eE][-+]?\d+)?$")
    return bool(pc.all(numbers).as_py())


def _split(name: str, cells: pa.Array) -> list[str]:
    """Return names for the numbers in each cell of a column; empty unless each cell has several."""
    if not pa.types.is_string(cells.type) or not re.search(r"\d[\s,;]+[-+.\d]", first_cell(cells)):
        return []
    is_point = pc.any(pc.match_substring_regex(cells, r"(?i)^\s*POINT")).as_py()
    known = pc.replace_substring_regex(cells.drop_null(), r"(?i)^\s*POINT\s*Z?", "")
    known = pc.utf8_trim(known, " ()[]")
    known = known.filter(pc.not_equal(known, ""))
    number = r"[-+]?\d+(?:\.\d+)?"
    counts = {
        count: pc.all(pc.match_substring_regex(known, rf"^{number}(?:[\s,;]+{number}){{{count - 1}}}$"))
        for count in (2, 3)
    }
    count = next((count for count, holds in counts.items() if holds.as_py()), 0)
    if not count:
        return []
    plain = parted(name)[0]
    if re.search("gps|gnss|pos|coord|location|lat|lon|lng|place|point", plain):
        first = re.search("lat|l(on|ng)", plain)
        is_east_first = is_point or (first and first[0] != "lat")
        names = ["longitude", "latitude"] if is_east_first else ["latitude", "longitude"]
        return [*names, "altitude"][:count]
    return [f"{name}.{number}" for number in range(count)]


def _numbers(cells: pa.Array) -> NDArray | None:
    """Read a column's numbers, NaN for empty cells; None if it contains anything else, or is empty."""
    if pa.types.is_timestamp(cells.type):
        return None
    try:
        found = floats(cells)
    except pa.ArrowException:
        return None
    return found if np.isfinite(found).any() else None


def _sided(name: str, cells: pa.Array) -> NDArray | None:
    """Read a column of positions such as 48.1N as signed numbers; None if it contains anything else."""
    if not (re.search(_PLACE, parted(name)[0]) and pa.types.is_string(cells.type)):
        return None
    numbers, letters = sided(cells)
    known = pc.fill_null(pc.not_equal(pc.utf8_trim_whitespace(cells), ""), False)
    if not pc.all(pc.is_in(letters.filter(known), pa.array([*"NSEW"]))).as_py():
        return None
    is_south = pc.fill_null(pc.is_in(letters, pa.array(["S", "W"])), False)
    return floats(pc.if_else(is_south, pc.negate(numbers), numbers))


# Columns that belong together.


def _rest(table: GuessedTable) -> list[str]:
    """Write a stream of the columns that fit no message."""
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


def of_device(columns: list[GuessedColumn]) -> list[GuessedColumn]:
    """Add the units and axes of known devices to columns."""
    units = {}
    by_name = {column.name: column for column in columns}
    if by_name.keys() >= {*_ARDUPILOT} and np.nanmedian(by_name[_ARDUPILOT[-1]].values) < 0:
        columns = [
            each._replace(frame="ned") if each.name in _ARDUPILOT[1:] else each for each in columns
        ]
    for column in columns:
        if column.name == _XSENS:
            steps = np.abs(np.diff(known_of(column)))
            rate_hz = 1e6 / np.median(steps) if steps.any() else 0.0
            units[column.name] = (
                "us" if np.isclose(rate_hz, _DOT_RATES_HZ, rtol=0.01).any() else "0.1 ms"
            )
    plain = {column.plain: column for column in columns}
    if any(names <= plain.keys() for names in _VBOX):
        latitude = plain.get("lat") or plain["latitude"]
        if _LARGEST_LATITUDE[0] < np.nanmax(np.abs(latitude.values)) <= _LARGEST_LATITUDE[1]:
            of_vbox = {name: each for name, each in plain.items() if name in VBOX_UNITS}
            units |= {each.name: each.unit or VBOX_UNITS[name] for name, each in of_vbox.items()}
    return [each._replace(unit=units.get(each.name, each.unit)) for each in columns]


def export_mapping(path: Path, columns: Sequence[str], batch: Batch) -> list[str]:
    """Write the lines of an exported table's mapping after `files`; return [] for other tables."""
    if tuple(columns[:3]) != _CLOCKS:
        return []
    fitting = [
        (schema, fields)
        for schema in schemas.SCHEMAS.values()
        if (fields := _fields(schema, columns[3:])) is not None
    ]
    if not fitting:
        return []
    topic = "/" + unquote(path.name.partition(".")[0]).replace("-", "/")
    name = topic.replace("_", "").lower()
    fitting.sort(key=lambda each: (list(each[1].values()).count([]), each[0].name.lower() not in name))
    schema, fields = fitting[0]
    times = [f'time = {{ column = "{_CLOCKS[0]}", unit = "ns", order = "any" }}']
    for name, clock in (("arrival", _CLOCKS[1]), ("sensor", _CLOCKS[2])):
        if not batch[clock].equals(batch[_CLOCKS[0]]):
            times.append(f'{name} = {{ column = "{clock}", unit = "ns", order = "any" }}')
    lines = []
    for name, given in fields.items():
        lines.append(f"fields.{name} = {json.dumps(given)}")
        components = [each.removeprefix(f"{name}_") for each in given] if isinstance(given, list) else []
        if name in _NAMED_VECTORS and components and not components[0].isdecimal():
            lines.append(f'components = "{",".join(components)}"')
            lines.append(f'kinds = "{",".join(map(_kind, components))}"')
    return [*times, *stream_lines(topic, schema.name, "the columns are those of fuselog export", *lines)]


def _fields(schema: Schema, columns: Sequence[str]) -> dict[str, str | list[str]] | None:
    """Assign columns to a message's fields; return None if a column is left over or a field has none."""
    found: dict[str, str | list[str]] = {}
    left = list(columns)
    for entry in sorted(list(schema)[1:], key=lambda each: -len(each.name)):
        if entry.kind == "vector":
            own = [name for name in left if name.startswith(f"{entry.name}_")]
            found[entry.name] = own
        else:
            own = [name for name in left if name == entry.name]
            if own:
                found[entry.name] = own[0]
        if not own and not entry.may_be_absent and entry.kind != "vector":
            return None
        left = [name for name in left if name not in own]
    return None if left else {entry.name: found[entry.name] for entry in schema if entry.name in found}


def _kind(component: str) -> str:
    if re.fullmatch(r"(.*_)?orientation_[wxyz]", component):
        return "quaternion"
    return "angle" if component.endswith("_rad") else "linear"
