"""Reads stamps of tables: numbers since some zero, dates, GPS weeks, or a rate; exact to the ns."""

import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field, PositiveFloat, model_validator

from recorders.errors import BadInput
from recorders.importers.stamps import NOT_A_TIME, Stamps, read_ns, to_ns
from recorders.parameters import Parameters

# How many digits after the second (or what else the unit is) are nanoseconds.
_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
_GPS_ZERO = "1980-01-06"
_WEEK_NS = 7 * 86400 * 10**9
_MEND = "check `unit`, and give in `zero` the date that the times count from"
ISO = "ISO8601"
# Hours ahead of UTC of zones by their short names, as far as these mean one zone.
ZONES = {
    "UTC": 0.0, "GMT": 0.0, "WET": 0.0, "WEST": 1.0, "CET": 1.0, "MEZ": 1.0, "CEST": 2.0, "MESZ": 2.0,
    "EET": 2.0, "EEST": 3.0, "EST": -5.0, "EDT": -4.0, "CDT": -5.0, "MST": -7.0, "MDT": -6.0,
    "PST": -8.0, "PDT": -7.0, "JST": 9.0, "AEST": 10.0, "AEDT": 11.0,
}  # fmt: skip
# The name of a zone at the end of a cell.
ZONED = r"\s+([A-Z]{2,5}|[A-Z]\w+/\w+)$"
_WRITTEN = re.compile(
    r"(?:(\d{1,4})([./-])(\d{1,2})\2(\d{1,4}))?(?:([ T,]*)"
    r"(\d{1,2}:\d{2})(:\d{2})?(?:([.,])\d+)?( ?[AaPp][Mm])?)?"
)


class TimeMapping(Parameters):
    """States where a row's time stands.

    Attributes:
        column: one column, or several whose texts belong together, such as date and time.
        unit: unit of numbers; "date" is for dates and times as text.
        zero: date that numbers count from.
        week: column of GPS weeks; `column` then has the seconds of the week.
        rate_hz: rows per second of files without stamps, from `zero` on.
        utc_offset_h: how far clocks of this place are ahead of UTC, for dates that do not say it.
        zone: name of the zone of these clocks, such as Europe/Berlin, which knows summer time, or CET.
        format: format of dates that are not as ISO 8601 has them, in the letters of strptime; of times
            without a date, the day is that of `zero`.
        leap_seconds: leap seconds that are subtracted, in s; GPS time is otherwise kept as it is
            written.
        tag: suffix of a file beside each file that says when its counter started, and how fast it goes
            (RTKLIB's time tags).
    """

    column: str | list[str] = []
    unit: Literal["s", "ms", "us", "ns", "date"] = "s"
    zero: str = "1970-01-01"
    week: str | None = None
    rate_hz: PositiveFloat | None = None
    utc_offset_h: Annotated[float, Field(ge=-15, le=15)] = 0.0
    zone: str | None = None
    format: str = ISO
    leap_seconds: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    tag: str | None = None

    @model_validator(mode="after")
    def _check(self) -> "TimeMapping":
        if bool(self.columns) == (self.rate_hz is not None):
            raise ValueError("give either `column`, which has the times, or `rate_hz`")
        if len(self.columns) > 1 + bool(self.week) and self.unit != "date":
            raise ValueError('several columns together are a date; give unit = "date", or one column')
        if self.zone is not None:
            offset_of(self.zone)
            if self.utc_offset_h or self.unit != "date":
                raise ValueError("`zone` is for dates, and in place of `utc_offset_h`; give one of them")
        try:
            _date_ns(self.zero)
        except ValueError:
            raise ValueError(
                f"zero is '{self.zero}', expected a date such as 2026-01-31T12:00:00Z"
            ) from None
        return self

    @property
    def columns(self) -> list[str]:
        """Return all columns that are read, in order."""
        texts = [self.column] if isinstance(self.column, str) else self.column
        return [*texts, *([self.week] if self.week else [])]

    @property
    def zero_ns(self) -> int:
        """Return what numbers count from, less leap seconds and the offset from UTC."""
        since = _date_ns(_GPS_ZERO if self.week else self.zero)
        return since - round((self.leap_seconds + 3600 * self.utc_offset_h) * 1e9)


def offset_of(zone: str) -> float | ZoneInfo:
    """Return how many hours a zone is ahead of UTC, or its rules where these are not always the same.

    Raises ValueError where there is no such zone.
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
    """Yield the formats that a date or time of day as text may have, the likeliest first.

    >>> list(formats_of("05.10.2026 14:03:07,25"))
    ['%d.%m.%Y %H:%M:%S,%f']
    """
    found = _WRITTEN.fullmatch(cell) or _WRITTEN.fullmatch(re.sub(ZONED, "", cell))
    if not (cell and found):
        yield ISO
        return
    first, mark, _, third, between, clock, second_of, point, half = found.groups()
    of_day = ""
    if clock:
        of_day = ("%I" if half else "%H") + ":%M" + ":%S" * bool(second_of)
        of_day += f"{point}%f" * bool(point) + (" %p" if half and half[0] == " " else "%p" * bool(half))
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
        is_day_first = mark == "." or int(first) > 12
        dates = [day_first] if is_day_first else [month_first, day_first]
    for parts in dates:
        yield mark.join(parts) + (between or "") + of_day


def _date_ns(text: str) -> int:
    stamp = pd.Timestamp(text)
    return int((stamp.tz_localize("UTC") if stamp.tzinfo is None else stamp).as_unit("ns").value)


def stamps_ns(
    mapping: TimeMapping, columns: Mapping[str, pa.Array], first_row: int, size: int, where: str
) -> Stamps:
    """Return the stamps (n,) of rows in ns, `NOT_A_TIME` where there is none.

    `first_row` is the number of rows before these. Raises BadInput, which begins with `where`, where a
    cell holds no time, or one beyond what a log can hold.
    """
    if mapping.rate_hz is not None:
        seconds = (first_row + np.arange(size)) / mapping.rate_hz
        return to_ns(seconds, 10**9, mapping.zero_ns, where=where, mend="check `rate_hz` and `zero`")
    cells = [columns[name] for name in mapping.columns]
    label = f"{where}: column {' and '.join(mapping.columns)}"
    if mapping.unit == "date":
        found = to_ns(_dates_ns(mapping, cells, label), 1, mapping.zero_ns, where=label, mend=_MEND)
    elif mapping.week:
        of_week = read_ns(cells[0], _DIGITS[mapping.unit], where=label, mend=_MEND)
        weeks = read_ns(cells[1], 0, where=label, mend=_MEND)
        since = to_ns(of_week, 1, mapping.zero_ns, where=label, mend=_MEND)
        found = to_ns(weeks, _WEEK_NS, since, where=label, mend=_MEND)
    else:
        found = read_ns(cells[0], _DIGITS[mapping.unit], mapping.zero_ns, where=label, mend=_MEND)
    if np.any(found[found != NOT_A_TIME] < 0):
        raise BadInput(f"{label}: a stamp is before 1970 or after 2262; {_MEND}")
    return found


def _dates_ns(mapping: TimeMapping, cells: list[pa.Array], label: str) -> Stamps:
    """Read dates as ns since 1970, as if their own offset were the mapping's."""
    if pa.types.is_timestamp(cells[0].type):
        return read_ns(cells[0], 0, where=label, mend=_MEND)
    texts = [pc.utf8_trim_whitespace(each.cast(pa.string())) for each in cells]
    joined = pc.binary_join_element_wise(*texts, " ") if len(texts) > 1 else texts[0]
    if mapping.format == ISO:  # pandas knows no fractions after a comma
        joined = pc.replace_substring_regex(joined, r"(:\d\d),(\d)", r"\1.\2")
    zones = pd.Series([mapping.zone or "UTC"]).repeat(len(joined)).to_numpy()
    if "%p" not in mapping.format and pc.any(pc.match_substring_regex(joined, ZONED)).as_py():
        named = joined.to_pandas().str.extract(ZONED, expand=False)
        zones = named.fillna(mapping.zone or "UTC").to_numpy()
        joined = pc.replace_substring_regex(joined, ZONED, "")
    try:
        dates = pd.to_datetime(joined.to_pandas(), format=mapping.format, utc=True)
        since_ns = _since_ns(dates.dt.tz_localize(None))
        if mapping.format != ISO and not re.search("%[YyGcxs]", mapping.format):
            since_ns[since_ns != NOT_A_TIME] -= _date_ns("1900-01-01")
        for zone in pd.unique(zones):
            rows = (zones == zone) & (since_ns != NOT_A_TIME)
            since_ns[rows] = _from_zone(since_ns[rows], offset_of(zone), label)
    except ValueError as error:
        why = str(error).splitlines()[0]
        raise BadInput(
            f"{label} has cells that are not dates ({why}); give their `format`, or the unit of numbers"
        ) from None
    return since_ns


def _since_ns(dates: pd.Series) -> Stamps:
    return dates.dt.as_unit("ns").to_numpy().astype(np.int64)


def _from_zone(local_ns: Stamps, zone: float | ZoneInfo, label: str) -> Stamps:
    """Change stamps (n,) by a zone's clocks to UTC; an hour that comes twice is taken for its first."""
    if not isinstance(zone, ZoneInfo):
        return to_ns(local_ns, 1, -round(3600e9 * zone), where=label, mend=_MEND)
    local = pd.Series(local_ns.astype("datetime64[ns]"))
    first = np.ones(len(local), bool)
    placed = local.dt.tz_localize(zone, ambiguous=first, nonexistent="shift_forward")
    return _since_ns(placed.dt.tz_convert("UTC").dt.tz_localize(None))


class Counter(NamedTuple):
    """Describes a file's own counter, in ns: where it begins, when that was, what one ns of it takes.

    `cut_ns` is the last reading where its line was cut off within it, else NOT_A_TIME.
    """

    first_ns: int
    start_ns: int
    rate: float
    cut_ns: int

    def stamps_ns(self, ticks_ns: Stamps, where: str) -> Stamps:
        """Return the stamps (n,) of readings; one of a line that was cut off has none."""
        since = np.rint(to_ns(ticks_ns, 1, -self.first_ns, where=where) * self.rate)
        none = (ticks_ns < self.first_ns) | (ticks_ns == self.cut_ns)
        return to_ns(np.where(none, np.nan, since), 1, self.start_ns, where=where)


def read_counter(path: Path, suffix: str, ticks_ns: Iterator[Stamps]) -> Counter:
    """Return the counter of a file by its time tag, RTKLIB's, of the file's name and `suffix`.

    A tag has from byte 64 on a time_t and a fraction of a second, when the file was begun, and from byte
    76 on pairs of 4 bytes: ms since then, and how long the file was. `ticks_ns` are all readings.

    Raises BadInput where there is no such file, or it is none.
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
            f"{path}: its counter does not increase, so that {tag.name} does not give its times; give "
            "the file as RTKLIB wrote it"
        )
    rate = float(last_ms) * 1e6 / float(last - first)
    cut_ns = int(every[-1]) if every[-1] < last else NOT_A_TIME
    return Counter(first, seconds * 10**9 + round(fraction * 1e9), rate, cut_ns)
