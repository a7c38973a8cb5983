"""Guesses of the columns with a table's times, and of their format; ambiguous tables are rejected.

If a column could be the time, no rate is assumed.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import NOT_A_TIME, Stamps
from fuselog.recorders.importers.tables.columns import (
    ASSUMED,
    TIME_OF_DAY,
    GuessedColumn,
    column_named,
    known_of,
    parted,
)
from fuselog.recorders.importers.tables.files import Batch
from fuselog.recorders.importers.tables.layout import MISSING, NUMBER
from fuselog.recorders.importers.tables.times import (
    DIGITS,
    ISO,
    OWN_OFFSET,
    ZONED,
    Order,
    TimeMapping,
    Undecided,
    formats_of,
    is_reversed,
    offset_of,
    rollover_of,
    stamps_ns,
    texts_of,
)
from fuselog.recorders.models.geodesy import local_metres

UNKNOWN_ZERO = "2026-01-01"
# The zero of times in FIT files, and the number of seconds above which times rather count from 1970.
_FIT_ZERO, _FIT_END = "1989-12-31", 1.3e9
_SIZES = {unit: 10.0 ** (digits - 9) for unit, digits in DIGITS.items()}
_LIKELY = ("s", "ms", "us", "ns")
# Unix time, in s, of 2000 and of 2050: the range of numbers that count from 1970.
_DATES_S = (946_684_800.0, 2_524_608_000.0)
# Unix time, in s, at which the clocks of receivers begin if they were never set, and a year later.
_UNSET_S = (315_964_800.0, 347_500_800.0)
# The longest time, in s, that is not a date: a year.
_LONGEST_S = 31_557_600.0
_UNIT_WORDS = {
    "ms": r"ms|millis(ec(ond)?s?)?|msecs?",
    "us": r"us|micros(ec(ond)?s?)?|usecs?",
    "ns": r"ns|nanos(ec(ond)?s?)?|nsecs?",
}
_NAMED = re.compile(
    r"(?<!life)time|stamp|utc|epoch|clock|zeit|^(s|ms|us|ns)$|"
    r"(^|_)(t|secs?|seconds?|i?tow|millis(econds?)?|micros(econds?)?|msecs?|usecs?|nsecs?|ticks?|elapsed)"
    r"(_|$|\d)|(^|_)(excel|serial_date|date_?num|mjd|julian)(_|$)"
)
_COUNTERS = re.compile(
    r"(.*_)?(seq|sequence|index|idx|row|frame|sample|count|counter|number|num|no|nr|id|record|step|point|"
    r"distance|dist|odometer|unnamed|level)s?(_?(id|no|nr|number|count|index|m|km|0))?|"
)
_WEEKS = r"(gps_?|gnss_?)?(week|wn)(_?(no|nr|num|number))?|gwk"
_SECONDS_OF_WEEK = r"(gps_?)?((i_?)?tow|time_of_week|seconds_of_week|sow)|gms"
# Names of columns with fractions of seconds, and where they end.
_FRACTIONS = {
    "ns": (r"nsecs?|nano_?secs?|nanoseconds?|nanos?|ns", 1e9),
    "us": (r"usecs?|micro_?secs?|microseconds?|micros?|us", 1e6),
    "ms": (r"msecs?|milli_?secs?|milliseconds?|millis?|ms", 1e3),
}
# How many cells are searched at a time for one that is not empty.
_CELLS = 1000
# Names of columns that count days, as in Excel and MATLAB.
_DAYS = r"(^|_)(excel|serial|date_?num|matlab|mjd|julian)(_|$)"
# The column of a message's own stamp, and columns without a proper name.
_OF_HEADER = r"(^|_)header_?(time_?)?stamp"
_NAMELESS = r"(value|field|column|col|var|data|unnamed)?_?\d*"
_PLACE = r"(.*_)?(lat(itude)?|lon|lng|long(itude)?|x|y|z|east(ing)?|north(ing)?|alt(itude)?|height)"
_OFFSETS = r"(.*_)?((utc|gmt)_?of+se?t|utcofst|tz_?offset|time_?zone_?offset)|tz"
_LIKE_A_TIME = r"\d{1,2}:\d{2}|\d{1,4}[./-]\d{1,2}[./-]\d{1,4}|\d[ ./-][A-Z][a-z]{2,8}[ ./-]\d{2}"
# The least usual step in s, by what a table holds; usual steps span three decades, so that one unit
# fits.
_STEPS_S = {"inertial": 5e-4, "fix": 0.02, "other": 2e-3}
_VEHICLES = re.compile(
    r"(.*_)?(mmsi|imei|imo|icao(24)?|callsign|call_sign|(vehicle|veh|robot|drone|uav|aircraft|flight|device|"
    r"tracker|tag|ship|vessel|boat|car|bus|taxi|truck|bike|trip|track|animal|individual|bird|collar|user|"
    r"rider|runner|driver|agent|asset|unit|node|person|player|machine|entity|object)"
    r"(_?(id|no|nr|num|number|name|code|local_identifier|identifier|ident))?)|id|name"
)
_PARTS = (
    ("doy|yday|julian_day|day_of_(the_)?year|ddd", "%j"),
    ("year|yr|yyyy", "%Y"), ("month|mon|mm", "%m"), ("(?<!of_)(day|dd)", "%d"),
    ("hour|hr|hh", "%H"), ("minute|min", "%M"), ("second|sec|ss", "%S"),
)  # fmt: skip
_RANGES = {
    "%Y": (1980, 2050), "%j": (1, 366), "%m": (1, 12), "%d": (1, 31), "%H": (0, 23), "%M": (0, 59),
    "%S": (0, 60),
}  # fmt: skip
_DAYS_IN_PARTS = (["%Y", "%j"], ["%Y", "%m", "%d"])
# Names of latitudes, longitudes, x, y and speeds.
_OF_MOTION = (
    r"(.*_)?lat(itude)?", r"(.*_)?(lon|lng|long)(gitude)?", r"(.*_)?(x|east(ing)?)",
    r"(.*_)?(y|north(ing)?)", r"(.*_)?(speed|sog|velocity|v)",
)  # fmt: skip
# Frame numbers, whose rate is not in the table.
_FRAMES = r"(.*_)?(frame|image|img)(_?(id|no|nr|num|number|idx|index|count|counter))?"
# The clock of all messages of ArduPilot, and that of the computer that received them.
_ARDUPILOT, _RECEIVED = "TimeUS", "timestamp"


class GuessedTime(NamedTuple):
    """A table's time: its TOML, the columns that it uses, and comments with facts and assumptions.

    `stamps` (n,) are the stamps of the rows, or None if no column has them; `vehicle` is the column that
    identifies the vehicle of each row.
    """

    text: str
    used: set[str]
    comments: list[str]
    stamps: Stamps | None
    vehicle: str


class _Table(NamedTuple):
    """The first rows of a table, its columns of numbers and texts, and the vehicle of each row (n,).

    `has_others` is whether other tables have to share a clock with this one; `stamps` caches the stamps
    by mapping.
    """

    path: Path
    batch: Batch
    columns: Sequence[GuessedColumn]
    texts: Sequence[str]
    vehicle: str
    codes: NDArray[np.int64]
    kind: str
    has_others: bool
    stamps: dict[str, Stamps]


def guess_time(
    path: Path,
    batch: Batch,
    columns: Sequence[GuessedColumn],
    texts: Sequence[str],
    *,
    has_others: bool = False,
) -> GuessedTime:
    """Guess the time of a table's rows; `has_others` is whether other tables are guessed with it.

    Raises BadInput if columns could be times, but the choice is ambiguous.
    """
    plain = {column.plain for column in columns}
    vehicle = _vehicle(batch, columns, texts)
    table = _Table(
        path, batch, columns, texts, vehicle, _codes(batch, vehicle), _kind_of(plain), has_others, {}
    )
    refusals: list[BadInput] = []
    try:
        for mapping, comments in _candidates(table):
            found = _tried(table, mapping, comments, refusals)
            if found is not None:
                return found._replace(comments=[*found.comments, *_passed_over(table, found.used)])
    except BadInput as error:
        refusals.append(error)
    if refusals:
        raise next((each for each in refusals if isinstance(each, Undecided)), refusals[0])
    return GuessedTime(
        f'{{ rate_hz = 1, zero = "{UNKNOWN_ZERO}" }}',
        set(),
        [f"{ASSUMED}one row a second from {UNKNOWN_ZERO} on, as no column could be a time; rate_hz"],
        None,
        vehicle,
    )


def _kind_of(plain: set[str]) -> str:
    if any(re.search("acc|gyr|specific_force|angular_vel", name) for name in plain) or (
        {"ax", "ay"} <= plain or {"gx", "gy"} <= plain
    ):
        return "inertial"
    is_fix = any(re.fullmatch(r"(.*_)?lat(itude)?", name) for name in plain)
    return "fix" if is_fix else "other"


# Vehicles.


def _vehicle(batch: Batch, columns: Sequence[GuessedColumn], texts: Sequence[str]) -> str:
    """Return the column that identifies the vehicle of each row, or an empty string."""
    plain = {column.name: column.plain for column in columns} | {name: parted(name)[0] for name in texts}
    is_placed = any(
        re.fullmatch(r"(.*_)?(lat(itude)?|x(_center)?|east(ing)?)", each) for each in plain.values()
    )
    if not is_placed or any(re.fullmatch(r"(.*_)?(range|bearing)", each) for each in plain.values()):
        return ""
    return next(
        (
            name
            for name, known in plain.items()
            if _VEHICLES.fullmatch(known) and _separates(batch[name])
        ),
        "",
    )


def _separates(cells: pa.Array) -> bool:
    """Test whether cells have only a few different values, each of them several times."""
    if pa.types.is_floating(cells.type) and not _are_whole(cells.to_numpy(zero_copy_only=False)):
        return False
    counts = pc.value_counts(cells.drop_null()).field("counts")
    return (
        len(counts) > 1
        and len(counts) <= max(len(cells) // 3, 1)
        and float(pc.mean(counts).as_py()) >= 3
    )


def _are_whole(values: NDArray) -> bool:
    known = values[np.isfinite(values)]
    return bool(np.all(known == np.rint(known)))


def _codes(batch: Batch, vehicle: str) -> NDArray[np.int64]:
    if not vehicle:
        return np.zeros(len(next(iter(batch.values()))), np.int64)
    codes = batch[vehicle].cast(pa.string()).dictionary_encode().indices
    return np.asarray(codes.fill_null(-1).to_numpy(zero_copy_only=False), np.int64)


def _parts(stamps: Stamps, codes: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Split the rows with a time by vehicle."""
    known = stamps != NOT_A_TIME
    return [np.flatnonzero(known & (codes == code)) for code in np.unique(codes) if code >= 0]


# Columns, and formats of times.


def _candidates(table: _Table) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield candidates for the time, the likeliest first; raise BadInput if several are possible."""
    dated: set[str] = set()
    yield from _of_ardupilot(table)
    yield from _dates(table, dated)
    yield from _calendars(table)
    yield from _clocks_of_day(table)
    yield from _pairs(table)
    named = [column for column in table.columns if _NAMED.search(column.plain)]
    named.sort(key=lambda column: (_epoch_unit(column) == "", not re.search(_OF_HEADER, column.plain)))
    for column in named:
        if not _epoch_unit(column):
            _check_calendars(table)
        yield from _counted(table, column)
    _check_calendars(table)
    _check_texts(table, dated)
    others = [column for column in table.columns if column.name not in {each.name for each in named}]
    for column in others:
        if _epoch_unit(column) and (_rises(column.values) or _rises(np.negative(column.values))):
            yield from _counted(table, column)
    others = [column for column in others if _rises(column.values)]
    first = [] if named else [column for column in others if column is table.columns[0]]
    for column in first:
        if not (_COUNTERS.fullmatch(column.plain) or re.fullmatch(_PLACE, column.plain)):
            yield from _counted(table, column)
    for column in others:
        if re.fullmatch(_NAMELESS, column.plain) and _is_steady(column.values):
            raise BadInput(
                f"{table.path}: column {column.name} rises steadily, and could be the time; write a "
                f'mapping yourself, with time = {{ column = "{column.name}", unit = ... }}, or with '
                "`rate_hz` in `time`"
            )
    _check_frames(table)


def _of_ardupilot(table: _Table) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield the clock that all messages of ArduPilot share, so that tables have the same clock."""
    by_name = {column.name: column for column in table.columns}
    if _ARDUPILOT in by_name and (table.has_others or _RECEIVED in by_name):
        received = by_name.get(_RECEIVED)
        is_date = received is not None and _epoch_unit(received) == "s"
        yield from _counted(table, received if received and is_date else by_name[_ARDUPILOT])


def _check_frames(table: _Table) -> None:
    """Raise BadInput for rows of several vehicles, or with frame numbers, that have no time."""
    frames = column.name if (column := column_named(table.columns, _FRAMES)) else ""
    of_several = f"several vehicles, by column {table.vehicle}" if table.vehicle else ""
    if not (frames or of_several):
        return
    whose = f', and in the table vehicle = "{table.vehicle}"' if table.vehicle else ""
    of_frames = f"column {frames} counts frames, but the frame rate is not in the file" if frames else ""
    time = f'column = "{frames}", rate_hz = 25' if frames else 'column = "COLUMN", unit = "s"'
    raise BadInput(
        f"{table.path}: {of_frames or 'no column could be the time of the rows of ' + of_several}; "
        "write a "
        f"mapping yourself with time = {{ {time} }}" + " for 25 a second" * bool(frames) + whose
    )


def _rises(values: NDArray) -> bool:
    """Test whether numbers nearly always rise, and whether the last is above the first."""
    known = values[np.isfinite(values)]
    return len(known) > 1 and float(np.mean(np.diff(known) >= 0)) >= 0.9 and bool(known[-1] > known[0])


def _is_steady(values: NDArray) -> bool:
    """Test whether numbers have nearly equal steps, other than the steps of a row count."""
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 1 and 0 < steps.max() <= 1.5 * steps.min() and not np.all(steps == 1)


def _passed_over(table: _Table, used: set[str]) -> list[str]:
    """Name the columns with other dates that were not chosen as the time."""
    others = [
        column.name
        for column in table.columns
        if column.name not in used and _NAMED.search(column.plain) and _epoch_unit(column)
    ]
    if not others:
        return []
    names = " and ".join(sorted(used))
    why = " of the measurement" if any(re.search(_OF_HEADER, parted(each)[0]) for each in used) else ""
    return [f"{ASSUMED}{names}: the time{why}, not {', '.join(others)}; column"]


def _tried(
    table: _Table, mapping: TimeMapping, comments: list[str], refusals: list[BadInput]
) -> GuessedTime | None:
    """Try one candidate; if it cannot be the time, return None, usually with a reason in `refusals`."""
    columns = mapping.columns
    try:
        stamps = _stamps(table, mapping)
    except Undecided:
        raise
    except BadInput as error:
        refusals.append(error)
        return None
    comments = [*comments]
    known = stamps[stamps != NOT_A_TIME]
    label = f"{table.path}: column {' and '.join(columns)}"
    if len(known) < 2 or known.min() == known.max():
        if len(known) > 1:
            refusals.append(
                BadInput(
                    f"{label} could be the time, but is the same in all rows; write a mapping yourself "
                    "with the `time` of the rows, as docs/your-log.md explains"
                )
            )
        return None
    vehicle, codes = table.vehicle, table.codes
    parts = _parts(stamps, codes)
    back = -1 if is_reversed([stamps[part] for part in parts]) else 1
    if any(np.any(np.diff(stamps[part][::back]) < 0) for part in parts):
        rollover = 0 if mapping.unit == "date" else _rollover(table, mapping, parts, back)
        if rollover:
            mapping = mapping.model_copy(update={"rollover": float(rollover)})
            comments.append(
                f"{ASSUMED}{columns[0]}: rolls over at {rollover}, and is unwrapped; rollover"
            )
            stamps = _stamps(table, mapping)
        elif back == 1 and not vehicle:
            vehicle = _separating(table, stamps, columns)
            codes = _codes(table.batch, vehicle) if vehicle else codes
        parts = _parts(stamps, codes)
    if back == -1:
        comments.append(f"{ASSUMED}rows: newest first, as their times decrease, so reversed; order")
    try:
        for part in parts:
            order = Order(label, mapping)
            order.follow(stamps[part][::back], part[::back])
            order.end()
    except BadInput as error:
        refusals.append(error)
        return None
    if vehicle:
        comments.append(f"{ASSUMED}{vehicle}: {len(parts)} vehicles, each with a namespace; vehicle")
    seen = _seen([stamps[part] for part in parts])
    return GuessedTime(_toml(mapping), {*columns}, [*seen, *comments], stamps, vehicle)


def _stamps(table: _Table, mapping: TimeMapping) -> Stamps:
    """Read the stamps of all rows, once for each mapping."""
    key = repr(mapping)
    if key not in table.stamps:
        rows = np.arange(len(table.codes))
        table.stamps[key] = stamps_ns(mapping, table.batch, rows, str(table.path))
    return table.stamps[key]


def _rollover(table: _Table, mapping: TimeMapping, parts: Sequence[NDArray[np.int64]], back: int) -> int:
    """Return the number at which the counters of all vehicles roll over; 0 if there is none."""
    column = next(each for each in table.columns if each.name == mapping.columns[0])
    found = set()
    for part in parts if len(mapping.columns) == 1 else ():
        counts = np.asarray(column.values)[part][::back]
        steps = np.diff(counts)
        if np.any(steps < 0):
            found.add(
                rollover_of(counts, float(np.median(steps[steps > 0]))) if np.any(steps > 0) else 0
            )
    return found.pop() if len(found) == 1 else 0


def _separating(table: _Table, stamps: Stamps, used: Sequence[str]) -> str:
    """Return the column that splits rows into groups with increasing times, or an empty string."""
    others = [*table.texts, *(column.name for column in table.columns)]
    for name in others:
        if name in used or not _separates(table.batch[name]):
            continue
        parts = _parts(stamps, _codes(table.batch, name))
        if all(np.all(np.diff(stamps[part]) > 0) for part in parts):
            return str(name)
    return ""


def _toml(mapping: TimeMapping) -> str:
    given = mapping.model_dump(exclude_defaults=True)
    if mapping.week or not isinstance(given["column"], list):
        pass
    elif len(given["column"]) == 1:
        given["column"] = given["column"][0]
    if given.get("rollover"):
        given["rollover"] = int(given["rollover"])
    given.setdefault("unit", mapping.unit)
    order = ["column", "week", "unit", "zone", "zero"]
    names = [*(name for name in order if name in given), *(name for name in given if name not in order)]
    parts = [f"{name} = {json.dumps(given[name], ensure_ascii=False)}" for name in names]
    return f"{{ {', '.join(parts)} }}"


# Texts.


def _dates(table: _Table, dated: set[str]) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield dates and times from columns of text, and add the names of these columns to `dated`."""
    plain = {name: parted(name)[0] for name in table.texts}
    days = [name for name in plain if re.fullmatch("(.*_)?(date|day)", plain[name])]
    days += [column.name for column in table.columns if re.fullmatch("(.*_)?date", column.plain)]
    hours = [name for name in plain if re.fullmatch("(.*_)?(time|clock|utc|hour)", plain[name])]
    for name in filter(str.isdecimal, table.texts):
        cell = first_cell(table.batch[name])
        days += [name] * bool(re.fullmatch(r"\d{1,4}([./-])\d{1,2}\1\d{1,4}", cell))
        hours += [name] * bool(re.match(r"\d{1,2}:\d{2}", cell))
    offsets = [
        name for name, cell in _offsets(table).items() if re.fullmatch(r"[Zz]|[-+]\d\d:?\d\d", cell)
    ][:1]
    pairs = [[day, hour, *offsets] for day in days for hour in hours]
    named = sorted(
        table.texts, key=lambda name: not _NAMED.search(plain[name] + " date" * (name in days))
    )
    singles = [[name, *more] for name in named for more in ([offsets] * bool(offsets) + [[]])]
    for names in (*pairs, *singles):
        if found := _dated(table, names):
            if "zero" in found[0].model_fields_set and days and names[0] not in days:
                if dated & {*days}:
                    continue
                cell = first_cell(table.batch[days[0]])
                raise Undecided(
                    f"{table.path}: column {names[0]} has times of the day, and {days[0]} dates such as "
                    f"'{cell}' in an unknown format; write a mapping yourself, with time = "
                    f'{{ column = ["{days[0]}", "{names[0]}"], unit = "date", format = ... }}'
                )
            dated |= {*names}
            yield found


def _offsets(table: _Table) -> dict[str, str]:
    """Return the columns named as offsets from UTC, with their first cells."""
    found = {
        name: first_cell(table.batch[name])
        for name in table.batch
        if re.fullmatch(_OFFSETS, parted(name)[0])
    }
    return {name: cell for name, cell in found.items() if cell}


def _check_texts(table: _Table, dated: set[str]) -> None:
    """Raise BadInput for a column of times in an unknown format."""
    for name in table.texts:
        cell = first_cell(table.batch[name])
        is_named = _NAMED.search(parted(name)[0]) and re.search(r"\d.*\d", cell)
        if name not in dated and (is_named or re.search(_LIKE_A_TIME, cell)):
            texts = texts_of(table.batch[name]).to_pylist()
            odd = [each for each in texts if each and not _is_number(each)]
            if odd and _is_number(cell):
                raise BadInput(
                    f"{table.path}: column {name} holds times such as '{cell}', but '{odd[0]}' in row "
                    f"{texts.index(odd[0]) + 1} is not a number; correct it, or remove the row"
                )
            raise BadInput(
                f"{table.path}: column {name} holds times such as '{cell}' in an unknown format; write "
                f'a mapping yourself, with time = {{ column = "{name}", unit = "date", format = ... }}, '
                "as docs/your-log.md explains"
            )


def _is_number(cell: str) -> bool:
    return cell.lower() in MISSING or re.fullmatch(NUMBER, cell, re.ASCII) is not None


def first_cell(cells: pa.Array, *, is_part: bool = False) -> str:
    """Return the text of the first cell that is not empty, or an empty string."""
    for begin in range(0, len(cells), _CELLS):
        texts = texts_of(cells[begin : begin + _CELLS], is_part=is_part).to_pylist()
        if found := next(filter(None, texts), ""):
            return str(found)
    return ""


def _first_cells(table: _Table, names: Sequence[str]) -> str:
    return " ".join(first_cell(table.batch[name], is_part=len(names) > 1) for name in names)


def _dated(table: _Table, names: Sequence[str]) -> tuple[TimeMapping, list[str]] | None:
    """Find the format of times in text columns; return None if they contain no times."""
    cell = _first_cells(table, names)
    if not re.search(r"\d", cell):
        return None
    given: dict[str, Any] = {"column": list(names), "unit": "date"}
    comments = []
    if zone := _zone(names):
        given["zone"] = zone
    elif not (
        any("utc" in parted(name)[0].split("_") for name in names)
        or re.search(OWN_OFFSET, cell)
        or ("%p" not in next(formats_of(cell)) and re.search(ZONED, cell))
        or _has_zone(table.batch[names[0]].type)
    ):
        if unread := _offsets(table).keys() - {*names}:
            name = min(unread)
            raise Undecided(
                f"{table.path}: column {name} states offsets from UTC such as "
                f"'{first_cell(table.batch[name])}', which are not used with {' and '.join(names)}; "
                "write a mapping yourself, with `utc_offset_h` or `zone` in `time`"
            )
        comments = [
            f"{ASSUMED}{' and '.join(names)}: in UTC, as no zone is stated; zone or utc_offset_h"
        ]
    if re.match(r"\d{1,2}:\d{2}", cell) is not None:
        given["zero"] = UNKNOWN_ZERO
        comments.append(
            f"{ASSUMED}{' and '.join(names)}: of the day {UNKNOWN_ZERO}, as no date is stated; zero"
        )
    fitting: dict[str, Stamps] = {}
    for pattern in formats_of(cell):
        mapping = TimeMapping.model_validate({**given, "format": pattern})
        try:
            stamps = _stamps(table, mapping.model_copy(update={"zone": "UTC"} if zone else {}))
        except Undecided:
            raise
        except BadInput:
            continue
        if np.any(stamps != NOT_A_TIME):
            fitting[pattern] = stamps
        if pattern == ISO and fitting:
            break
    if not fitting:
        return None
    pattern = _continuous(table, names, fitting)
    others = [each for each in fitting if not np.array_equal(fitting[each], fitting[pattern])]
    if others:
        comments.append(
            f"{ASSUMED}{' and '.join(names)}: {_first_part(pattern)} first, as times jump with "
            f"{_first_part(others[0])} first; format"
        )
    return TimeMapping.model_validate({**given, "format": pattern}), comments


def _first_part(pattern: str) -> str:
    """Name the first part of a format."""
    return {"%d": "the day", "%m": "the month"}.get(pattern[:2], "the year")


def _has_zone(kind: pa.DataType) -> bool:
    return pa.types.is_timestamp(kind) and kind.tz is not None


def _continuous(table: _Table, names: Sequence[str], stamps_by: Mapping[str, Stamps]) -> str:
    """Choose the format in which rows follow one another without jumps of months or years.

    Raises BadInput if several formats do so equally well, since the day is then ambiguous.
    """
    spans = {}
    for pattern, stamps in stamps_by.items():
        steps = [np.diff(stamps[part]) for part in _parts(stamps, table.codes)]
        moved = np.abs(np.concatenate(steps)) if steps else np.empty(0)
        spans[pattern] = float(moved.max(initial=0.0))
    best = min(spans, key=lambda each: spans[each])
    alike = [
        each
        for each in spans
        if spans[each] <= 2.0 * spans[best] and not np.array_equal(stamps_by[each], stamps_by[best])
    ]
    if alike:
        row = int(np.argmax(stamps_by[best] != stamps_by[alike[0]]))
        cell = " ".join(str(table.batch[name][row]) for name in names)
        first, second = (pd.Timestamp(int(stamps_by[each][row])) for each in (best, alike[0]))
        raise BadInput(
            f"{table.path}: column {' and '.join(names)} holds dates such as '{cell}', which may be "
            f"{first:%-d %B %Y} or {second:%-d %B %Y}; write a mapping with `format` in `time`, "
            f'"{best}" or "{alike[0]}"'
        )
    return best


def _zone(names: Sequence[str]) -> str:
    """Return the zone in brackets in a column's name."""
    for text in re.findall(r"[\[(]\s*([^\])]+?)\s*[\])]", " ".join(names)):
        try:
            offset_of(text)
        except ValueError:
            continue
        return str(text)
    return ""


# Numbers of dates and times of day.


def _calendars(table: _Table) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield dates in separate columns (year, month and day, or day of the year) with the time of day."""
    parts = _parts_of_date(table)
    day = [letters for letters in ("%Y", "%j", "%m", "%d") if letters in parts]
    if day not in _DAYS_IN_PARTS:
        return
    clock = [letters for letters in ("%H", "%M", "%S") if letters in parts]
    if clock == ["%H", "%M", "%S"]:
        found = [parts[letters] for letters in (*day, *clock)]
        cells = [first_cell(table.batch[name]) for name in found]
        formats = [
            letters + ".%f" * ("." in cell) for letters, cell in zip([*day, *clock], cells, strict=True)
        ]
    else:
        of_day = {name: next(formats_of(first_cell(table.batch[name]))) for name in table.texts}
        name = next((name for name in of_day if of_day[name].startswith(("%H", "%I"))), "")
        if not name:
            return
        found = [*(parts[letters] for letters in day), name]
        formats = [*day, of_day[name]]
    yield (
        TimeMapping(column=found, unit="date", format=" ".join(formats)),
        [f"{ASSUMED}{', '.join(found)}: in UTC, as no zone is stated; zone or utc_offset_h"],
    )


def _parts_of_date(table: _Table) -> dict[str, str]:
    """Return the columns with parts of dates and times, by format letter; empty without a year."""
    found: dict[str, str] = {}
    for pattern, letters in _PARTS:
        for column in table.columns:
            if column.name not in found.values() and re.fullmatch(f"(.*_)?({pattern})", column.plain):
                found.setdefault(letters, column.name)
    if "%j" in found:
        found = {letters: name for letters, name in found.items() if letters not in ("%m", "%d")}
    if all(column.name.isdecimal() for column in table.columns):
        found = _nameless_parts(table)
    cell = first_cell(table.batch[found["%Y"]]) if "%Y" in found else ""
    return found if re.fullmatch(r"(19|20)\d\d", cell.partition(".")[0]) else {}


def _nameless_parts(table: _Table) -> dict[str, str]:
    """Infer from their numbers which unnamed columns are the parts of a date; empty if ambiguous."""
    fitting = []
    for day in _DAYS_IN_PARTS:
        own = {
            letters: column.name
            for letters, column in zip([*day, "%H", "%M", "%S"], table.columns, strict=False)
            if _RANGES[letters][0] <= np.nanmin(column.values)
            and np.nanmax(column.values) <= _RANGES[letters][1]
            and (letters == "%S" or _are_whole(column.values))
        }
        fitting += [own] if len(own) == len(day) + 3 else []
    return fitting[0] if len(fitting) == 1 else {}


def _check_calendars(table: _Table) -> None:
    """Raise BadInput for dates in several columns whose time of day has an unknown format."""
    parts = _parts_of_date(table)
    if [letters for letters in ("%Y", "%j", "%m", "%d") if letters in parts] in _DAYS_IN_PARTS:
        raise BadInput(
            f"{table.path}: columns {', '.join(parts.values())} hold the date in parts, but the time of "
            "day has an unknown format; add a column of times such as 2026-05-03T10:00:00Z, or write a "
            'mapping with the columns and their `format` in `time`, such as "%Y %j %H %M %S"'
        )


def _clocks_of_day(table: _Table) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield times as hhmmss, as in NMEA, with or without a date as ddmmyy or yyyymmdd."""
    for column in table.columns:
        cell = first_cell(table.batch[column.name])
        if not (
            re.search("time|utc|clock|hour", column.plain) and re.fullmatch(r"\d{5,6}(\.\d+)?", cell)
        ):
            continue
        known = known_of(column)
        whole = np.floor(known)
        is_of_day = (
            np.all(known < 240_000) and np.all(whole % 100 < 60) and np.all(whole // 100 % 100 < 60)
        )
        day = column_named(table.columns, "(.*_)?date")
        next_minute = np.any(np.diff(whole) == 41)  # from 59 to 100
        is_sure = np.ptp(known) >= 60 or next_minute or cell.startswith("0") or day is not None
        is_sure = is_sure or "utc" in column.plain.split("_") or column.unit == TIME_OF_DAY
        if not (is_of_day and is_sure):
            continue
        clock = "%H%M%S" + ".%f" * ("." in cell)
        if day is None:
            mapping = TimeMapping(column=column.name, unit="date", format=clock, zero=UNKNOWN_ZERO)
            yield (
                mapping,
                [f"{ASSUMED}{column.name}: hhmmss in UTC of the day {UNKNOWN_ZERO}; format, zero"],
            )
            continue
        digits = len(first_cell(table.batch[day.name]).partition(".")[0])
        date = "%Y%m%d" if digits == 8 else "%d%m%y"
        mapping = TimeMapping(column=[day.name, column.name], unit="date", format=f"{date} {clock}")
        how = "yyyymmdd" if digits == 8 else "ddmmyy, as NMEA has it,"
        yield mapping, [f"{ASSUMED}{day.name} and {column.name}: {how} and hhmmss in UTC; format"]


# Numbers that count.


def _pairs(table: _Table) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield GPS weeks with seconds of the week, and seconds with their fractions in another column."""
    week, tow = (column_named(table.columns, pattern) for pattern in (_WEEKS, _SECONDS_OF_WEEK))
    if week is not None and tow is not None:
        is_ms = re.fullmatch("i_?tow|gms", tow.plain) or np.nanmax(tow.values) > 604_800
        unit = tow.unit if tow.unit in _SIZES else "ms" if is_ms else "s"
        mapping = TimeMapping(column=tow.name, week=week.name, unit=unit)  # type: ignore[arg-type]
        yield (
            mapping,
            [f"{ASSUMED}{week.name} and {tow.name}: GPS time, not UTC; leap_seconds = 18 makes it UTC"],
        )
    for whole in table.columns:
        stem = re.fullmatch(r"(.*?)_?(secs?|seconds?|s)", _full(whole))
        if not stem or not _are_whole(whole.values):
            continue
        for unit, (pattern, most) in _FRACTIONS.items():
            full = re.compile(rf"{re.escape(stem[1])}_?({pattern})")
            parts = (each for each in table.columns if full.fullmatch(_full(each)))
            fractions = (
                each for each in parts if np.nanmin(each.values) >= 0 and np.nanmax(each.values) < most
            )
            if part := next(fractions, None):
                is_date = _DATES_S[0] < np.nanmedian(whole.values) < _DATES_S[1]
                zero = {} if is_date else {"zero": UNKNOWN_ZERO}
                given = {"column": [whole.name, part.name], "unit": ["s", unit], **zero}
                both = f"{whole.name} and {part.name}"
                why = f"{ASSUMED}{both}: from {UNKNOWN_ZERO}, as no date is stated; zero"
                yield TimeMapping.model_validate(given), [] if is_date else [why]


def _full(column: GuessedColumn) -> str:
    """Return a column's name in lower case with underscores, followed by its unit."""
    return f"{column.plain}_{column.unit}" if column.unit in _SIZES else column.plain


def _stated_unit(column: GuessedColumn) -> str:
    """Return the unit that the name of a column of times states, or an empty string."""
    if column.unit in _SIZES:
        return column.unit
    last = column.plain.rpartition("_")[2]
    return next((unit for unit, words in _UNIT_WORDS.items() if re.fullmatch(words, last)), "")


def _epoch_unit(column: GuessedColumn) -> str:
    """Return the unit in which a column's numbers are dates from 2000 to 2050, or an empty string."""
    known = known_of(column)
    if not len(known):
        return ""
    middle = float(np.median(known))
    units = [stated] if (stated := _stated_unit(column)) else _LIKELY
    return next((unit for unit in units if _DATES_S[0] < middle * _SIZES[unit] < _DATES_S[1]), "")


def _counted(table: _Table, column: GuessedColumn) -> Iterator[tuple[TimeMapping, list[str]]]:
    """Yield a column of numbers as times; raise BadInput if its unit is ambiguous."""
    known = known_of(column)
    steps = np.abs(np.diff(known))
    steps = steps[steps > 0]
    if not len(steps):
        if _NAMED.search(column.plain):
            unit = _epoch_unit(column)
            given = {"unit": unit} if unit else {"zero": UNKNOWN_ZERO}
            yield TimeMapping.model_validate({"column": column.name, **given}), []
        return
    step, largest = float(np.median(steps)), float(np.abs(known).max())
    unit, comments, zero = _epoch_unit(column), [], {}
    if not unit and re.search(_DAYS, column.plain):
        raise BadInput(
            f"{table.path}: column {column.name} counts days, by its name; convert them to seconds or "
            "dates, and state these in `time`"
        )
    if unit in ("", "s") and _LONGEST_S < largest < _FIT_END and _is_fit(table):
        unit, zero = "s", {"zero": _FIT_ZERO}
        comments = [f"{ASSUMED}{column.name}: from {_FIT_ZERO}, as files of FIT have it; zero"]
    elif not unit and _UNSET_S[0] < float(known.min()) and largest < _UNSET_S[1]:
        unit = "s"
        comments = [f"{ASSUMED}{column.name}: s from 1970, by a clock that was never set (1980); zero"]
    elif not unit:
        zero = {"zero": UNKNOWN_ZERO}
        unit, why = _stated_unit(column), ""
        if not unit:
            unit, why = _relative_unit(table, column, step)
        if largest * _SIZES[unit] > _LONGEST_S:
            raise BadInput(
                f"{table.path}: column {column.name} could be the time, but reaches {largest:.6g}, "
                f"which in {unit} is neither a date since 1970 nor less than a year; write a mapping "
                'yourself with the `unit` and `zero` of `time`, such as zero = "1904-01-01"'
            )
        comments = [
            f"# Stamps begin at {known[0]:g}.",
            f"{ASSUMED}{column.name}: in {unit}{why} from {UNKNOWN_ZERO}, as no date is stated; unit, "
            "zero",
        ]
    elif "gps" in column.plain and unit == "s":
        comments = [f"{ASSUMED}{column.name}: from 1970, not from GPS's 1980-01-06; zero"]
    given = {"column": column.name, "unit": unit, **zero}
    yield TimeMapping.model_validate(given), comments


def _is_fit(table: _Table) -> bool:
    return column_named(table.columns, "(.*_)?position_lat") is not None


def _relative_unit(table: _Table, column: GuessedColumn, step: float) -> tuple[str, str]:
    """Choose the unit of a counter with unknown zero from the speeds, or else from its steps."""
    if (ratio := _seconds_a_count(table, column)) is not None:
        nearest = min(_LIKELY, key=lambda each: abs(np.log(_SIZES[each] / ratio)))
        if abs(np.log10(_SIZES[nearest] / ratio)) < 1.0:
            return nearest, ", in which positions agree with the speed,"
    least_s = _STEPS_S[table.kind]
    fitting = [unit for unit in _LIKELY if least_s <= step * _SIZES[unit] < 1000 * least_s]
    unit = fitting[0] if fitting else "s" if step >= 1 else "ns"
    rate_hz = 1.0 / (step * _SIZES[unit])
    if not 1e-5 < rate_hz < 2e4:
        raise BadInput(
            f"{table.path}: column {column.name} could be the time, but its steps of {step:.3g} fit no "
            "unit; write a mapping yourself with the `unit` and `zero` of `time`; convert days, as in "
            "Excel and MATLAB, to seconds or dates first"
        )
    return unit, f", {rate_hz:.4g} rows a second,"


def _seconds_a_count(table: _Table, column: GuessedColumn) -> float | None:
    """Estimate the seconds per count of a column from the distances and speeds of rows."""
    latitude, longitude, first, second, speeds = (
        column_named(table.columns, each) for each in _OF_MOTION
    )
    if speeds is None:
        return None
    if latitude and longitude:
        if not 1.6 <= np.nanmax(np.abs(latitude.values)) <= 90:
            return None
        east, north = local_metres(latitude.values, longitude.values).T
    elif first and second:
        east, north = np.asarray(first.values), np.asarray(second.values)
    else:
        return None
    known = np.isfinite(east) & np.isfinite(north) & np.isfinite(column.values)
    counts = np.abs(np.diff(np.asarray(column.values)[known]))
    moved = np.hypot(np.diff(east[known]), np.diff(north[known]))
    speed = float(np.nanmedian(np.abs(speeds.values)))
    if not (len(counts) and speed > 0 and moved.sum() > 0 and counts.sum() > 0):
        return None
    return float(moved.sum() / counts.sum() / speed)


# Comments on what was seen.


def _seen(parts: Sequence[Stamps]) -> list[str]:
    """Write the rate, gaps and repetitions of stamps, separately for each vehicle."""
    steps_s = np.concatenate([np.diff(part) for part in parts]) * 1e-9
    if is_reversed(parts):
        steps_s = -steps_s
    forward = steps_s[steps_s > 0]
    if not len(forward):
        return ["# All rows have the same stamp."]
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
