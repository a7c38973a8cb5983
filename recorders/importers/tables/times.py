"""Stamps of tables: numbers that count from a zero, dates, GPS weeks, or a rate; exact to 1 ns."""

import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, model_validator

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import NOT_A_TIME, Stamps, to_ns
from fuselog.recorders.importers.tables.cells import read_ns
from fuselog.recorders.parameters import Parameters

CountUnit = Literal["s", "ms", "0.1 ms", "us", "ns"]
Unit = Literal["s", "ms", "0.1 ms", "us", "ns", "date"]
# How many digits after the unit's decimal point are nanoseconds.
DIGITS = {"s": 9, "ms": 6, "0.1 ms": 5, "us": 3, "ns": 0}
_GPS_ZERO = "1980-01-06"
_WEEKS = 1024  # after which receivers with ten bits roll over to 0
_WEEK_NS = 7 * 86400 * 10**9
# Settings that cannot be combined with a column of frames.
_UNCOUNTED = {"unit", "week", "rollover"}
REMEDY = "check `unit`, and state in `zero` the date from which the times count"
ISO = "ISO8601"
# Offsets from UTC in h of zones with short names, if the name is unambiguous.
ZONES = {
    "UTC": 0.0, "GMT": 0.0, "WET": 0.0, "WEST": 1.0, "CET": 1.0, "MEZ": 1.0, "CEST": 2.0, "MESZ": 2.0,
    "EET": 2.0, "EEST": 3.0, "EST": -5.0, "EDT": -4.0, "CDT": -5.0, "MST": -7.0, "MDT": -6.0,
    "PST": -8.0, "PDT": -7.0, "JST": 9.0, "AEST": 10.0, "AEDT": 11.0,
}  # fmt: skip
# The name of a zone at the end of a cell.
ZONED = r"\s+([A-Z]{2,5}|[A-Z]\w+/\w+)$"
# The offset from UTC at the end of a cell with a time.
OWN_OFFSET = r":\d\d.*?(?:[Zz]|(?P<sign>[-+])(?P<h>[01]\d)(?::?(?P<m>\d\d))?)$"
_OFFSET = re.compile(r"(?<=\d)( ?)([Zz]|[-+][01]\d:?\d\d)$")
_SPACED = r"(:[\d.]+) ([-+]\d\d:?\d\d)$"
_CLOCK = r"(?:([ T,]*)(\d{1,2}:\d{2})(:\d{2})?(?:([.,])\d+)?( ?[AaPp][Mm])?)?"
_WRITTEN = re.compile(r"(?:(\d{1,4})([./-])(\d{1,2})\2(\d{1,4}))?" + _CLOCK)
# Day of the year, and a time of day as in AndroSensor and in names of files.
_ORDINAL = re.compile(r"\d{4}([-:./ ])\d{3}(?:([ T:])(\d{1,2}:\d{2})(:\d{2})?(?:([.,])\d+)?)?")
_DASHED = re.compile(r"\d{4}-\d\d-\d\d[ _T]\d\d(-\d\d-\d\d([_:.]\d{1,6})?|:\d\d:\d\d:\d{1,6})")
# Name of the month in the second or first place.
_DAY_MONTH = re.compile(r"\d{1,2}([-/. ])([A-Z][a-z]{2,8})\1\d{4}" + _CLOCK)
_MONTH_DAY = re.compile(r"([A-Z][a-z]{2,8}) \d{1,2}(,?) \d{4}" + _CLOCK)

# How many successive rows, and by how many usual steps, are behind an earlier row if a clock was reset.
_ROWS, _STEPS = 10, 5.0
_ROWS_AT_END = 3
# Beyond this number of usual steps, a single row is not late, but has another clock or no time.
_FAR_STEPS = 100.0
# The share of steps that go back in a file with the newest row first.
_REVERSED = 0.9
# Numbers at which counters roll over: powers of two, and days and weeks in several units.
_ROLLOVERS = (
    *(2**bits for bits in (16, 24, 31, 32)),
    *(span * 10**digits for digits in (0, 3, 6) for span in (86_400, 604_800)),
    *(10**digits for digits in (4, 5, 6, 7, 8, 9)),
    60, 3600, 60_000,
)  # fmt: skip


class Undecided(BadInput):
    """An error for times that can be read in several ways; it names the setting that decides."""


class TimeMapping(Parameters):
    """The columns with the time of a row, and its format.

    Attributes:
        column: one column, or several that belong together, such as the texts of date and time, or
            seconds and nanoseconds.
        unit: unit of numbers; "date" is for dates and times as text. Several columns of numbers have a
            list of units, such as ["s", "ns"], and are added.
        zero: date from which numbers count; by default 1970-01-01, or 1980-01-06 if `week` is given.
        week: column of GPS weeks; `column` then has the seconds of the week.
        rate_hz: rows per second, counted from `zero`, of files without stamps; with `column`, counts of
            that column per second, as for frame numbers.
        utc_offset_h: how far local clocks are ahead of UTC, for dates that do not state it.
        zone: name of the local time zone, such as Europe/Berlin, which includes summer time, or CET.
        format: format of dates that do not follow ISO 8601, in the letters of strptime; for times
            without a date, the day is that of `zero`.
        leap_seconds: leap seconds to subtract, in s; by default GPS time is kept as it is.
        tag: suffix of RTKLIB's time tags: next to each file, a tag states when the file's counter
            started, and the counter's rate.
        rollover: number at which the counter rolls over to 0, such as 4294967296; it is then unwrapped.
        order: order of the rows; "rising" allows single late rows, and reverses a file whose rows are
            newest first; "any" sorts rows regardless of their order.
        file: a file with the times of the rows, one in each line, instead of a column; a path relative
            to the given folder.
    """

    column: str | list[str] = []
    unit: Unit | list[CountUnit] = "s"
    zero: str = "1970-01-01"
    week: str | None = None
    rate_hz: PositiveFloat | None = None
    utc_offset_h: Annotated[float, Field(ge=-15, le=15)] = 0.0
    zone: str | None = None
    format: str = ISO
    leap_seconds: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    tag: str | None = None
    rollover: PositiveFloat | None = None
    order: Literal["rising", "any"] = "rising"
    file: str | None = None

    @model_validator(mode="after")
    def _check(self) -> "TimeMapping":
        if bool(self.columns or self.rate_hz) + (self.file is not None) != 1:
            raise ValueError("give either `column`, which has the times, or `rate_hz`, or `file`")
        if (
            self.rate_hz
            and self.columns
            and (len(self.columns) > 1 or self.model_fields_set & _UNCOUNTED)
        ):
            raise ValueError(
                "`rate_hz` with `column` expects frame numbers in a single column; remove `unit`, "
                "`week` and `rollover`, or `rate_hz`"
            )
        counted = len(self.columns) - bool(self.week)
        if isinstance(self.unit, list) and len(self.unit) != counted:
            raise ValueError(f"unit has {len(self.unit)} units for {counted} columns; give one for each")
        if counted > 1 and self.unit != "date" and not isinstance(self.unit, list):
            raise ValueError(
                'several columns together need unit = "date", or a list of units whose numbers are '
                'added, such as unit = ["s", "ns"]'
            )
        if self.rollover and self.unit == "date":
            raise ValueError('`rollover` is for counters; remove it if unit = "date"')
        if self.zone is not None:
            offset_of(self.zone)
            if self.utc_offset_h or self.unit != "date":
                raise ValueError("`zone` is for dates, and replaces `utc_offset_h`; give one of the two")
        try:
            _date_ns(self.zero)
        except ValueError:
            raise ValueError(
                f"zero is '{self.zero}', expected a date such as 2026-01-31T12:00:00Z"
            ) from None
        return self

    @property
    def columns(self) -> list[str]:
        """Return all columns to read, in order."""
        texts = [self.column] if isinstance(self.column, str) else self.column
        return [*texts, *([self.week] if self.week else [])]

    @property
    def zero_ns(self) -> int:
        """Return the stamp at which numbers are zero, minus leap seconds and the offset from UTC."""
        since = _date_ns(_GPS_ZERO if self.counts_all_weeks else self.zero)
        return since - round((self.leap_seconds + 3600 * self.utc_offset_h) * 1e9)

    @property
    def counts_all_weeks(self) -> bool:
        """Test whether there are GPS weeks that count from 1980 without rollovers."""
        return self.week is not None and "zero" not in self.model_fields_set

    @property
    def units(self) -> list[CountUnit]:
        """Return the units of the columns of numbers, except the unit of weeks."""
        if isinstance(self.unit, list):
            return self.unit
        return [] if self.unit == "date" else [self.unit]


def offset_of(zone: str) -> float | ZoneInfo:
    """Return how many hours a zone is ahead of UTC, or its rules if this changes over the year.

    Raises ValueError for an unknown zone.
    """
    if zone in ZONES:
        return ZONES[zone]
    try:
        return ZoneInfo(zone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError(
            f"no time zone '{zone}'; give one such as Europe/Berlin, or one of {', '.join(ZONES)}"
        ) from None


def formats_of(cell: str) -> Iterator[str]:
    """Yield possible formats of a text with a date or time of day, the likeliest first.

    >>> list(formats_of("05.10.2026 14:03:07,25"))
    ['%d.%m.%Y %H:%M:%S,%f']
    """
    offset = _OFFSET.search(cell)
    bare = cell[: offset.start()] if offset else cell
    of_offset = f"{offset[1]}%z" if offset else ""
    if named := _DAY_MONTH.fullmatch(bare):
        yield named[1].join(("%d", _month(named[2]), "%Y")) + _of_day(*named.groups()[2:]) + of_offset
        return
    if named := _MONTH_DAY.fullmatch(bare):
        yield f"{_month(named[1])} %d{named[2]} %Y" + _of_day(*named.groups()[2:]) + of_offset
        return
    if ordinal := _ORDINAL.fullmatch(bare):
        yield f"%Y{ordinal[1]}%j" + _of_day(*ordinal.groups()[1:]) + of_offset
        return
    if _DASHED.fullmatch(bare):
        yield _dashed(bare)
        return
    found = _WRITTEN.fullmatch(bare) or _WRITTEN.fullmatch(re.sub(ZONED, "", bare))
    if not (bare and found):
        yield ISO
        return
    first, mark, second, third = found.groups()[:4]
    of_day = _of_day(*found.groups()[4:]) + of_offset
    if not first:
        yield of_day
        return
    if len(first) == 4:
        if mark == "-":
            yield ISO
        dates = [("%Y", "%m", "%d")]
    else:
        year = "%Y" if len(third) == 4 else "%y"
        day_first, month_first = ("%d", "%m", year), ("%m", "%d", year)
        dates = [day_first] if mark == "." else [month_first, day_first]
        if year == "%y" and len(first) == len(second) == 2:
            dates.append(("%y", "%m", "%d"))
    for parts in dates:
        yield mark.join(parts) + of_day


def _month(name: str) -> str:
    return "%b" if len(name) == 3 else "%B"


def _dashed(cell: str) -> str:
    """Return the format of a date and time of day that match `_DASHED`."""
    marks = re.split(r"\d+", cell)[1:-1]
    parts = ("%Y", "%m", "%d", "%H", "%M", "%S", "%f")
    return "".join(part + mark for part, mark in zip(parts, [*marks, ""], strict=False))


def _of_day(
    between: str | None,
    clock: str | None,
    second: str | None,
    point: str | None,
    half: str | None = None,
) -> str:
    """Return the format of a time of day from the groups of `_CLOCK`."""
    if not clock:
        return ""
    parts = ["%I" if half else "%H", "%M", "%S"][: 2 + bool(second)]
    if point and not second:  # fractions of minutes are not in use
        parts = ["%M", "%S"]
    of_day = (between or "") + ":".join(parts) + f"{point}%f" * bool(point)
    return of_day + (" %p" if half and half[0] == " " else "%p" * bool(half))


def _date_ns(text: str) -> int:
    stamp = pd.Timestamp(text)
    return int((stamp.tz_localize("UTC") if stamp.tzinfo is None else stamp).as_unit("ns").value)


class Reading:
    """The state that is kept from one block of a file to the next while its times are read.

    Attributes:
        facts: decisions made while reading, with the number of rows.
    """

    def __init__(self) -> None:
        self.facts = Counter[str]()
        self.begin()

    def begin(self) -> None:
        """Forget the earlier rows."""
        self.count_ns = NOT_A_TIME  # the last number of a counter in the file
        self.turns = 0  # how often the counter has rolled over
        self.local_ns = NOT_A_TIME  # the last local time
        self.is_second = False  # whether a repeated hour is there for the second time

    def continued_ns(self, counted: Stamps, rollover_ns: int, label: str) -> Stamps:
        """Unwrap the readings (n,) of a counter that rolls over."""
        known = counted != NOT_A_TIME
        if not known.any():
            return counted
        values = counted[known]
        before = values[0] if self.count_ns == NOT_A_TIME else self.count_ns
        turns = self.turns + np.cumsum(-np.rint(np.diff(values, prepend=before) / rollover_ns))
        self.facts["rollovers of the counter, which is unwrapped"] += int(turns[-1]) - self.turns
        self.count_ns, self.turns = int(values[-1]), int(turns[-1])
        continued = counted.copy()
        continued[known] = to_ns(turns, rollover_ns, values, where=label, remedy=REMEDY)
        return continued


def stamps_ns(
    mapping: TimeMapping,
    columns: Mapping[str, pa.Array],
    rows: NDArray[np.int64],
    where: str,
    reading: Reading | None = None,
) -> Stamps:
    """Compute the stamps (n,) of rows in ns, `NOT_A_TIME` for missing ones.

    Args:
        mapping: the columns with the time, and their format.
        columns: cells (n,) by name.
        rows: (n,), numbers of the rows, from 0.
        where: beginning of error messages.
        reading: state from earlier rows.

    Raises BadInput if a cell contains no time, or a time that a log cannot store.
    """
    reading = reading or Reading()
    if mapping.rate_hz is not None:
        counts = rows if not mapping.columns else _frames(columns[mapping.columns[0]], mapping, where)
        return to_ns(
            counts / mapping.rate_hz,
            10**9,
            mapping.zero_ns,
            where=where,
            remedy="check `rate_hz` and `zero`",
        )
    cells = [columns[name] for name in mapping.columns]
    label = f"{where}: column {' and '.join(mapping.columns)}"
    if mapping.unit == "date":
        found = _dates_ns(mapping, cells, rows, label, reading)
    else:
        units = mapping.units
        found = np.zeros(len(cells[0]), np.int64)
        for each, unit in zip(cells, units, strict=False):
            found = read_ns(each, DIGITS[unit], found, where=label, remedy=REMEDY)
        if mapping.week:
            weeks = read_ns(cells[-1], 0, where=label, remedy=REMEDY)
            known = weeks[weeks != NOT_A_TIME]
            if mapping.counts_all_weeks and len(known) and known.min() < _WEEKS:
                raise Undecided(
                    f"{label}: GPS week {known.min()} is before 22 August 1999, or counts to 1023 only; "
                    'state in `zero` of `time` the date of week 0: "2019-04-07" for recordings after '
                    'that day, "1999-08-22" or "1980-01-06" for earlier ones'
                )
            found = to_ns(weeks, _WEEK_NS, found, where=label, remedy=REMEDY)
        if mapping.rollover is not None:
            rollover_ns = round(mapping.rollover * 10 ** DIGITS[units[0]])
            found = reading.continued_ns(found, rollover_ns, label)
        found = to_ns(found, 1, mapping.zero_ns, where=label, remedy=REMEDY)
    if np.any(found[found != NOT_A_TIME] < 0):
        raise BadInput(f"{label}: a stamp is before 1970 or after 2262; {REMEDY}")
    return found


def _frames(cells: pa.Array, mapping: TimeMapping, where: str) -> NDArray[np.float64]:
    """Read frame numbers (n,), NaN for empty cells."""
    label = f"{where}: column {mapping.columns[0]}"
    counts = read_ns(cells, 0, where=label, remedy="give a column of whole numbers")
    return np.where(counts == NOT_A_TIME, np.nan, counts)


def _dates_ns(
    mapping: TimeMapping, cells: list[pa.Array], rows: NDArray[np.int64], label: str, reading: Reading
) -> Stamps:
    """Read dates as ns since 1970 in UTC; an offset in a cell takes precedence."""
    leap_ns = round(mapping.leap_seconds * 1e9)
    zone = offset_of(mapping.zone) if mapping.zone is not None else mapping.utc_offset_h
    if len(cells) == 1 and pa.types.is_timestamp(cells[0].type):
        found = read_ns(cells[0], 0, where=label, remedy=REMEDY)
        if cells[0].type.tz is None:
            found = _from_zone(found, zone, rows, label, reading)
        return to_ns(found, 1, -leap_ns, where=label, remedy=REMEDY)
    texts = [_padded(texts_of(each, is_part=len(cells) > 1), mapping.format) for each in cells]
    joined = pc.binary_join_element_wise(*texts, " ") if len(texts) > 1 else texts[0]
    if mapping.format == ISO:  # pandas accepts no fractions after a comma, and no space before an offset
        for mark, written in ((",", r"(:\d\d),(\d)"), (" -", _SPACED), (" +", _SPACED)):
            if pc.any(pc.match_substring(joined, mark)).as_py():
                plain = r"\1.\2" if mark == "," else r"\1\2"
                joined = pc.replace_substring_regex(joined, written, plain)
    zones = np.zeros(len(joined), dtype=object)
    names: dict[str, float | ZoneInfo] = {}
    if "%p" not in mapping.format and pc.any(pc.match_substring_regex(joined, ZONED)).as_py():
        written = joined.to_pandas().str.extract(ZONED, expand=False)
        zones = np.where(written.isna(), 0, written.to_numpy(object))
        joined = pc.replace_substring_regex(joined, ZONED, "")
    found = pc.fill_null(pc.match_substring_regex(joined, OWN_OFFSET), False)
    own = found.to_numpy(zero_copy_only=False)
    try:
        names = {str(name): offset_of(str(name)) for name in set(zones.tolist()) - {0}}
        dates = pd.to_datetime(joined.to_pandas(), format=mapping.format, utc=True)
        since_ns = _since_ns(dates.dt.tz_localize(None))
    except ValueError as error:
        why = str(error).splitlines()[0]
        raise BadInput(
            f"{label} has cells that are not dates ({why}); give their `format`, or the unit of numbers"
        ) from None
    if mapping.format != ISO and not re.search("%[YyGcxs]", mapping.format):
        of_day_ns = to_ns(since_ns, 1, -_date_ns("1900-01-01"), where=label, remedy=REMEDY)
        since_ns = to_ns(of_day_ns, 1, _date_ns(mapping.zero), where=label, remedy=REMEDY)
    for name, own_zone in names.items():
        which = zones == name
        since_ns[which] = _from_zone(since_ns[which], own_zone, rows[which], label, reading)
    if zone == 0.0 and mapping.zone is None:
        local = ~own & (zones == 0) & (since_ns != NOT_A_TIME)
        if (stated := own | (zones != 0)).any() and local.any():
            first, other = int(np.argmax(local)), int(np.argmax(stated))
            raise Undecided(
                f"{label}: row {rows[first] + 1} holds '{joined[first]}' without a zone, and row "
                f"{rows[other] + 1} states one; give the zone of rows without one, such as "
                'zone = "UTC", in `time`'
            )
    elif zone and own.any():
        _check_offsets(since_ns[own], joined.filter(pa.array(own)), zone, rows[own], label)
    if zone:
        local = ~own & (zones == 0)
        since_ns[local] = _from_zone(since_ns[local], zone, rows[local], label, reading)
    return to_ns(since_ns, 1, -leap_ns, where=label, remedy=REMEDY) if leap_ns else since_ns


def texts_of(cells: pa.Array, *, is_part: bool = False) -> pa.Array:
    """Convert cells to texts; if the time of day is in another column, only the dates are kept."""
    if is_part and pa.types.is_timestamp(cells.type):
        return pc.strftime(cells, format="%Y-%m-%d")
    return pc.utf8_trim_whitespace(cells.cast(pa.string()))


def _padded(texts: pa.Array, pattern: str) -> pa.Array:
    """Restore leading zeros of numbers such as hhmmss."""
    if not re.search("%H%M%S|%d%m%y", pattern):
        return texts
    for lost in range(1, 6):
        texts = pc.replace_substring_regex(texts, rf"^(\d{{{6 - lost}}})(\.|$)", rf"{'0' * lost}\1\2")
    return texts


def _since_ns(dates: pd.Series) -> Stamps:
    return dates.dt.as_unit("ns").to_numpy().astype(np.int64)


def _check_offsets(
    found: Stamps, texts: pa.Array, zone: float | ZoneInfo, rows: NDArray[np.int64], label: str
) -> None:
    """Raise BadInput if a cell states another offset from UTC than the zone has at that time."""
    parts = texts.to_pandas().str.extract(OWN_OFFSET)
    hours = pd.to_numeric(parts["h"], errors="coerce").fillna(0).to_numpy()
    minutes = pd.to_numeric(parts["m"], errors="coerce").fillna(0).to_numpy()
    stated_h = np.where(parts["sign"] == "-", -1, 1) * (hours + minutes / 60)
    if isinstance(zone, ZoneInfo):
        there = pd.Series(found.astype("datetime64[ns]")).dt.tz_localize("UTC").dt.tz_convert(zone)
        zone_h = (_since_ns(there.dt.tz_localize(None)) - found) / 3600e9
    else:
        zone_h = np.full(len(found), zone)
    is_other = (np.abs(stated_h - zone_h) > 1e-6) & (found != NOT_A_TIME)
    if is_other.any():
        first = int(np.argmax(is_other))
        raise BadInput(
            f"{label}: row {rows[first] + 1} holds '{texts[first]}', whose offset from UTC differs from "
            f"that of the mapping, {zone_h[first]:+g} h; remove `zone` and `utc_offset_h` from `time`, "
            "as the cells have their own"
        )


def _from_zone(
    local_ns: Stamps, zone: float | ZoneInfo, rows: NDArray[np.int64], label: str, reading: Reading
) -> Stamps:
    """Convert stamps (n,) from a zone's local time to UTC.

    If an hour occurs twice, rows belong to its second occurrence once the times have jumped back. Raises
    BadInput for a time that the clocks skip.
    """
    known = np.flatnonzero(local_ns != NOT_A_TIME)
    placed = local_ns.copy()
    if not isinstance(zone, ZoneInfo):
        return to_ns(local_ns, 1, -round(3600e9 * zone), where=label, remedy=REMEDY)
    local = pd.Series(local_ns[known].astype("datetime64[ns]"))
    first = _since_utc(local, zone, is_first=True)
    second = _since_utc(local, zone, is_first=False)
    if (skipped := first == NOT_A_TIME).any():
        index = int(np.argmax(skipped))
        raise BadInput(
            f"{label}: row {rows[known[index]] + 1} has {local[index]}, a time that the clocks of "
            f"{zone.key} skip; if the logger's clock has no summer time, give utc_offset_h instead "
            "of zone"
        )
    doubled = first != second
    if doubled.any():
        is_second = np.zeros(len(local), bool)
        times = local_ns[known]
        steps = np.diff(times)
        usual_ns = np.median(steps[steps > 0]) if (steps > 0).any() else 0
        for index in np.flatnonzero(doubled).tolist():
            before = times[index - 1] if index else reading.local_ns
            is_inside = bool(doubled[index - 1]) if index else reading.is_second
            # if rows are an hour apart, two with the same local time are too
            is_equal = times[index] == before and usual_ns >= second[index] - first[index]
            goes_back = before != NOT_A_TIME and (times[index] < before or is_equal)
            reading.is_second = goes_back or (reading.is_second and is_inside)
            is_second[index] = reading.is_second
        first = np.where(is_second, second, first)
        reading.facts[
            f"times of the hour that occurs twice in {zone.key}, resolved by the order of rows"
        ] += int(doubled.sum())
    if len(known):
        reading.local_ns = int(local_ns[known[-1]])
        reading.is_second = reading.is_second and bool(doubled[-1])
    placed[known] = first
    return placed


def _since_utc(local: pd.Series, zone: ZoneInfo, *, is_first: bool) -> Stamps:
    """Convert local times (n,) to UTC, `NOT_A_TIME` for those that the clocks skip."""
    first = np.full(len(local), is_first)
    placed = local.dt.tz_localize(zone, ambiguous=first, nonexistent="NaT")
    return _since_ns(placed.dt.tz_convert("UTC").dt.tz_localize(None))


class Ticks(NamedTuple):
    """A file's own counter: its first reading in ns, the stamp of that reading, and its rate.

    `cut_ns` is the last reading if its line was truncated, otherwise NOT_A_TIME.
    """

    first_ns: int
    start_ns: int
    rate: float
    cut_ns: int

    def stamps_ns(self, ticks_ns: Stamps, where: str) -> Stamps:
        """Compute the stamps (n,) of readings; a reading from a truncated line gets no stamp."""
        since = np.rint(to_ns(ticks_ns, 1, -self.first_ns, where=where) * self.rate)
        none = (ticks_ns < self.first_ns) | (ticks_ns == self.cut_ns)
        return to_ns(np.where(none, np.nan, since), 1, self.start_ns, where=where)


def read_counter(path: Path, suffix: str, ticks_ns: Iterator[Stamps]) -> Ticks:
    """Read the counter of a file from RTKLIB's time tag, named after the file with `suffix`.

    From byte 64 on, a tag states when the file was begun, as a time_t and a fraction of a second. From
    byte 76 on, it has pairs of numbers of 4 bytes each: the ms since then, and the length of the file at
    that time. `ticks_ns` are all readings of the counter.

    Raises BadInput if the file is missing, or is not a time tag.
    """
    tag = path.with_name(path.name + suffix)
    try:
        data = tag.read_bytes()
    except OSError as error:
        raise BadInput(f"{tag}: {error.strerror}; {path.name} needs it to know its first time") from None
    is_whole = data.startswith(b"TIMETAG RTKLIB") and len(data) >= 84
    seconds, fraction = struct.unpack_from("<Id", data, 64) if is_whole else (0, np.nan)
    if not 0.0 <= fraction < 1.0:
        raise BadInput(
            f"{tag}: is not a time tag of RTKLIB, which {path.name} needs to know its first time"
        )
    last_ms = np.frombuffer(data, "<u4", (len(data) - 76) // 8 * 2, 76)[-2]
    every = np.concatenate([ticks[ticks != NOT_A_TIME] for ticks in ticks_ns] or [np.empty(0, np.int64)])
    first, last = (int(every[0]), int(every.max())) if len(every) else (0, 0)
    if last <= first:
        raise BadInput(
            f"{path}: its counter does not increase, so {tag.name} does not give its times; give the "
            "file as RTKLIB wrote it"
        )
    rate = float(last_ms) * 1e6 / float(last - first)
    cut_ns = int(every[-1]) if every[-1] < last else NOT_A_TIME
    return Ticks(first, seconds * 10**9 + round(fraction * 1e9), rate, cut_ns)


class Order:
    """A check of the order of one clock's stamps; `label` names the file and the column."""

    def __init__(self, label: str, mapping: TimeMapping) -> None:
        self._label, self._is_any = label, mapping.order == "any"
        self._unit_ns = 10 ** DIGITS[str(mapping.unit)] if str(mapping.unit) in DIGITS else 0
        self._zero_ns = mapping.zero_ns
        self._usual_ns = 0.0
        self._first_ns = self._reached_ns = NOT_A_TIME
        self._behind = 0  # rows behind the latest, up to now
        self._fall: tuple[int, int, int] | None = None  # its row, from where and to where

    def follow(self, stamps: Stamps, rows: NDArray[np.int64]) -> None:
        """Process the next stamps (n,) and their row numbers; raises BadInput like `end`."""
        if self._is_any or not len(stamps):
            return
        steps = np.diff(stamps)
        if not self._usual_ns and (steps > 0).any():
            self._usual_ns = float(np.median(steps[steps > 0]))
        if self._reached_ns == NOT_A_TIME:
            self._first_ns = self._reached_ns = int(stamps[0])
        if stamps[0] >= self._reached_ns and (not len(steps) or steps.min() >= 0):
            self._reached_ns, self._behind = int(stamps[-1]), 0
            return
        highest = np.maximum.accumulate(np.append(self._reached_ns, stamps))
        behind = stamps < highest[:-1]
        self._reached_ns = int(highest[-1])
        edges = np.flatnonzero(np.diff(np.concatenate([[0], behind.astype(np.int8), [0]])))
        for begin, end in edges.reshape(-1, 2):
            if begin > 0 or not self._behind:
                self._behind = 0
                self._fall = int(rows[begin]), int(highest[begin]), int(stamps[begin])
            self._behind += int(end - begin)
            self._check(_ROWS)
        if not behind[-1]:
            self._behind = 0

    def end(self) -> None:
        """Raise BadInput if the last rows are earlier than rows before them."""
        self._check(_ROWS_AT_END)

    def _check(self, fewest: int) -> None:
        if self._fall is None or not self._behind:
            return
        row, high, low = self._fall
        is_last = fewest == _ROWS_AT_END and high - low > 0.5 * (high - self._first_ns)
        is_before = low < self._first_ns - _FAR_STEPS * self._usual_ns
        is_clear = high - low > _STEPS * self._usual_ns
        if not (is_clear and (is_last or is_before or self._behind >= fewest)):
            return
        rollover = self._rollover(high, low)
        unwrap = f"`rollover = {rollover}` if the counter rolled over, " if rollover else ""
        raise BadInput(
            f"{self._label}: at row {row + 1} the time falls from {_written(high)} to {_written(low)}; "
            f'add to `time` {unwrap}`order = "any"` if rows are to be sorted by their times, or to the '
            'table `vehicle = "COLUMN"` if a column names the vehicle of each row; if the clock was '
            "restarted or set back, split the file there"
        )

    def _rollover(self, high_ns: int, low_ns: int) -> int:
        if not self._unit_ns:
            return 0
        high, low = ((each - self._zero_ns) / self._unit_ns for each in (high_ns, low_ns))
        return rollover_of(np.array([high, low]), self._usual_ns / self._unit_ns)


def rollover_of(counts: NDArray, usual: float) -> int:
    """Return the number at which a counter rolls over; 0 if its falls are not rollovers.

    Args:
        counts: (n,), readings of the counter.
        usual: usual step, by which the counter continues after a rollover.
    """
    steps = np.diff(counts)
    falls = np.flatnonzero(steps < 0)
    if not len(falls):
        return 0
    fitting = {}
    for number in _ROLLOVERS:
        onward = counts[falls + 1] + number - counts[falls]
        if (
            np.all(onward > 0.2 * usual)
            and np.all(onward < 5.0 * usual)
            and counts.max() < number + usual
        ):
            fitting[number] = float(np.abs(onward - usual).max())
    return min(fitting, key=lambda each: fitting[each]) if fitting else 0


def is_reversed(parts: Sequence[Stamps]) -> bool:
    """Test whether rows are newest first, for each vehicle separately."""
    steps = np.concatenate([np.diff(part[part != NOT_A_TIME]) for part in parts] or [np.empty(0)])
    moving = steps[steps != 0]
    return len(moving) > 1 and float(np.mean(moving < 0)) >= _REVERSED


def _written(stamp_ns: int) -> str:
    return str(pd.Timestamp(stamp_ns))
