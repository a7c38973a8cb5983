"""Draws tables of a known path as strangers write them, and judges what a guess makes of one.

Units, separators, forms of times, zones, orders, codes of missing values and styles of headers are drawn
at random. A table is read right, or refused, or read under an assumption that the guess states; else it
is wrong.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.guessing import assumptions, guess
from fuselog.recorders.importers.tables.importer import TableParameters, read
from fuselog.recorders.log import Stream

Verdict = Literal["right", "refused", "assumed", "wrong"]
METRES = 111_194.93  # of a degree
TIME_NS = 1_000_000  # to which all texts are exact


class Truth(NamedTuple):
    """What the rows of a table are in truth, in the order of time."""

    stamps_ns: NDArray[np.int64]
    latitude_deg: NDArray
    longitude_deg: NDArray
    altitude_m: NDArray
    speed_mps: NDArray
    heading_rad: NDArray  # clockwise from north


class Drawn(NamedTuple):
    """A table: its file, what is true, and how it was drawn."""

    path: Path
    truth: Truth
    choices: dict[str, str]
    is_absolute: bool  # whether its times say the date
    has_place: NDArray[np.bool_]


def truth_of(rng: np.random.Generator) -> Truth:
    """A path with bends anywhere on earth where people live."""
    rows = int(rng.integers(60, 240))
    step_s = float(rng.choice([0.05, 0.1, 0.2, 0.5, 1.0, 1.0, 5.0]))
    begin_s = int(rng.integers(1_420_000_000, 1_800_000_000))
    stamps = begin_s * 10**9 + np.rint(step_s * 1e9 * np.arange(rows)).astype(np.int64)
    stamps += int(rng.integers(0, 1000)) * 10**6
    speed = rng.uniform(2, 25) * (1 + 0.2 * np.sin(np.linspace(0, 5, rows)))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.02, rows))
    north = np.append(0, np.cumsum(speed * np.cos(heading) * step_s)[:-1])
    east = np.append(0, np.cumsum(speed * np.sin(heading) * step_s)[:-1])
    latitude = rng.choice([-1, 1]) * rng.uniform(5, 65) + north / METRES
    longitude = rng.uniform(-170, 170) + east / METRES / np.cos(np.radians(latitude))
    altitude = rng.uniform(5, 2000) + np.cumsum(rng.normal(0, 0.1, rows))
    return Truth(stamps, latitude, longitude, altitude, speed, heading)


def draw(folder: Path, rng: np.random.Generator) -> Drawn:
    """Write a table and say what is true of it."""
    truth = truth_of(rng)
    names: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    choices: dict[str, str] = {}

    def choose(what: str, *options: str) -> str:
        choices[what] = str(rng.choice(options))
        return choices[what]

    style = choose("style", "plain", "plain", "brackets", "units row", "camel")
    kind = choose("time", *TIMES)
    is_absolute = _times(kind, truth, rng, names)
    scale = choose(
        "place",
        *("deg", "deg", "deg", "1e-7", "1e-6 named", "semicircle", "ddmm", "hemispheres", "letters"),
    )
    _places(scale, truth, rng, names, units)
    height = choose("altitude", "none", "m", "m", "mm named", "ft named")
    if height != "none":
        factor, unit = {"m": (1.0, "m"), "mm named": (1000.0, "mm"), "ft named": (1 / 0.3048, "ft")}[
            height
        ]
        name = f"altitude_{unit}" if height != "m" else "altitude"
        names[name] = [f"{factor * each:.3f}" for each in truth.altitude_m]
    if choose("speed", "none", "m/s", "km/h", "kn") != "none":
        factor = {"m/s": 1.0, "km/h": 3.6, "kn": 3600 / 1852}[choices["speed"]]
        title = {"m/s": "speed", "km/h": "speed_kmh", "kn": "speed_kn"}[choices["speed"]]
        names[title] = [f"{factor * each:.3f}" for each in truth.speed_mps]
    if choose("heading", "none", "deg", "1e-5 deg") != "none":
        factor, digits = {"deg": (1.0, 2), "1e-5 deg": (1e5, 0)}[choices["heading"]]
        names["heading"] = [
            f"{factor * each:.{digits}f}" for each in np.degrees(truth.heading_rad) % 360.0
        ]
    has_place = np.ones(len(truth.stamps_ns), bool)
    if scale == "deg" and choose("missing", "none", "none", "91", "empty", "nan") != "none":
        lost = np.sort(rng.choice(len(has_place), 4, replace=False))
        has_place[lost] = False
        for name in ("latitude", "lat", "Latitude"):
            if name in names:
                other = {"latitude": "longitude", "lat": "lon", "Latitude": "Longitude"}[name]
                codes = {"91": ("91", "181"), "empty": ("", ""), "nan": ("nan", "nan")}
                for row in lost:
                    names[name][row], names[other][row] = codes[choices["missing"]]
    path = _write(folder, style, truth, rng, choose, names, units)
    return Drawn(path, truth, choices, is_absolute, has_place)


TIMES = (
    "s", "ms", "us", "ns", "iso", "iso offset", "iso T Z", "day first", "month first", "date and time",
    "secs nsecs", "relative s", "relative ms named", "rollover us named", "hhmmss and date", "zone",
    "day of year", "year to second", "dashed",
)  # fmt: skip


def _times(kind: str, truth: Truth, rng: np.random.Generator, names: dict[str, list[str]]) -> bool:
    """Add columns of times; return whether they say the date."""
    stamps = truth.stamps_ns
    since = stamps - stamps[0]
    utc = pd.to_datetime(stamps)
    title = str(rng.choice(["timestamp", "time", "Time", "t", "stamp"]))
    cells: dict[str, list[str]]
    is_absolute = True
    if kind in ("s", "ms", "us", "ns"):
        digits = {"s": 9, "ms": 6, "us": 3, "ns": 0}[kind]
        count = [each // 10**digits for each in stamps.tolist()]
        cells = {title: [f"{each / 1e9:.3f}" for each in stamps] if digits == 9 else [*map(str, count)]}
    elif kind == "iso":
        cells = {title: [f"{each:%Y-%m-%d %H:%M:%S.%f}" for each in utc]}
    elif kind == "iso T Z":
        cells = {title: [f"{each:%Y-%m-%dT%H:%M:%S.%f}Z" for each in utc]}
    elif kind in ("iso offset", "zone"):
        zone = ZoneInfo(str(rng.choice(["Europe/Berlin", "America/Denver", "Asia/Tokyo"])))
        local = utc.tz_localize("UTC").tz_convert(zone)
        cells = {title: [each.isoformat() for each in local]}
        if kind == "zone":
            cells = {f"{title} [{zone.key}]": [f"{each:%Y-%m-%d %H:%M:%S.%f}" for each in local]}
    elif kind == "day of year":
        cells = {title: [f"{each:%Y-%jT%H:%M:%S.%f}" for each in utc]}
    elif kind == "dashed":
        cells = {title: [f"{each:%Y-%m-%d %H-%M-%S}_{each.microsecond // 1000:03d}" for each in utc]}
    elif kind == "year to second":
        parts = {"year": "%Y", "doy": "%j", "hour": "%H", "minute": "%M", "second": "%S.%f"}
        cells = {name: [f"{each:{pattern}}" for each in utc] for name, pattern in parts.items()}
    elif kind in ("day first", "month first"):
        pattern = "%d/%m/%Y %H:%M:%S.%f" if kind == "day first" else "%m/%d/%Y %H:%M:%S.%f"
        cells = {title: [f"{each:{pattern}}" for each in utc]}
    elif kind == "date and time":
        cells = {
            "Date": [f"{each:%Y-%m-%d}" for each in utc],
            "Time": [f"{each:%H:%M:%S.%f}" for each in utc],
        }
    elif kind == "secs nsecs":
        stem = str(rng.choice(["header.stamp.", "stamp_", ""]))
        cells = {
            f"{stem}secs": [str(each // 10**9) for each in stamps.tolist()],
            f"{stem}nsecs": [str(each % 10**9) for each in stamps.tolist()],
        }
    elif kind == "relative s":
        cells, is_absolute = {title: [f"{each / 1e9:.3f}" for each in since]}, False
    elif kind == "relative ms named":
        cells, is_absolute = {"time_ms": [str(each // 10**6) for each in since.tolist()]}, False
    elif kind == "rollover us named":
        count = (since // 1000 + 2**32 - int(rng.integers(1_000_000, 4_000_000))) % 2**32
        cells, is_absolute = {"time_us": [str(each) for each in count.tolist()]}, False
    else:
        cells = {
            "date": [f"{each:%d%m%y}" for each in utc],
            "utc_time": [f"{each:%H%M%S}.{each.microsecond // 1000:03d}" for each in utc],
        }
    names.update(cells)
    return is_absolute


def _places(
    scale: str,
    truth: Truth,
    rng: np.random.Generator,
    names: dict[str, list[str]],
    units: dict[str, str],
) -> None:
    """Add columns of latitudes and longitudes, which are exact to some decimetres."""
    both = truth.latitude_deg, truth.longitude_deg
    titles = [("latitude", "longitude"), ("lat", "lon"), ("Latitude", "Longitude")][rng.integers(3)]
    if scale == "deg":
        digits = int(rng.integers(6, 9))
        for title, values in zip(titles, both, strict=True):
            names[title] = [f"{each:.{digits}f}" for each in values]
            units[title] = "deg"
        return
    if scale in ("1e-7", "1e-6 named"):
        power = 7 if scale == "1e-7" else 6
        titles = ("lat", "lon") if power == 7 else ("lat_e6", "lon_e6")
        for title, values in zip(titles, both, strict=True):
            names[title] = [str(round(each * 10**power)) for each in values.tolist()]
        return
    if scale == "semicircle":
        for title, values in zip(("position_lat", "position_long"), both, strict=True):
            names[title] = [str(round(each * 2**31 / 180)) for each in values.tolist()]
        return
    if scale == "letters":
        for title, values, letters in zip(titles, both, ("NS", "EW"), strict=True):
            names[title] = [f"{abs(each):.7f}{letters[int(each < 0)]}" for each in values]
        return
    if scale == "hemispheres":
        for title, values, letters in zip(titles, both, ("NS", "EW"), strict=True):
            names[title] = [f"{abs(each):.7f}" for each in values]
            names[f"{title}_dir"] = [letters[int(each < 0)] for each in values]
        return
    for title, values, letters, wide in zip(titles, both, ("NS", "EW"), (2, 3), strict=True):
        size = np.abs(values)
        minutes = 60 * (size - np.floor(size))
        names[title] = [
            f"{int(degrees):0{wide}d}{rest:08.5f}" for degrees, rest in zip(size, minutes, strict=True)
        ]
        names[f"{title}_dir"] = [letters[int(each < 0)] for each in values]


def _write(
    folder: Path,
    style: str,
    truth: Truth,
    rng: np.random.Generator,
    choose: Any,
    names: dict[str, list[str]],
    units: dict[str, str],
) -> Path:
    """Write the columns as text or as Parquet or JSON lines."""
    titles = list(names)
    shown = {title: title for title in titles}
    if style == "brackets":
        shown |= {title: f"{title} [{unit}]" for title, unit in units.items()}
    elif style == "camel":
        shown = {title: title[:1].upper() + title[1:] for title in titles}
    rows: list[tuple[str, ...]] = list(zip(*names.values(), strict=True))
    order = choose("order", "rising", "rising", "rising", "newest first")
    vehicles = choose("vehicles", "one", "one", "one", "one", "interleaved", "one after the other")
    if vehicles != "one":
        titles, shown = [*titles, "vehicle"], shown | {"vehicle": "vehicle"}
        names["vehicle"] = ["A"]
        parts = [[(*row, each) for row in rows] for each in ("A", "B")]
        rows = parts[0] + parts[1]
        if vehicles == "interleaved":
            rows = [row for both in zip(*parts, strict=True) for row in both]
    rows = rows[::-1] if order == "newest first" else rows
    container = choose("container", "csv", "csv", "csv", "parquet", "jsonl")
    if container != "csv":
        frame = pd.DataFrame(dict(zip(shown.values(), map(list, zip(*rows, strict=True)), strict=True)))
        for name in frame.columns:
            with_text = pd.to_numeric(frame[name].replace("", np.nan), errors="coerce")
            is_padded = frame[name].str.match(r"0\d").any()
            if with_text.notna().sum() > 0.5 * len(frame) and not is_padded:
                frame[name] = with_text
        path = folder / f"table.{container}"
        if container == "parquet":
            frame.to_parquet(path)
        else:
            text = [
                json.dumps(
                    {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in row.items()}
                )
                for row in frame.to_dict("records")
            ]
            path.write_text("\n".join(text) + "\n")
        return path
    delimiter = choose("delimiter", ",", ";", "\t")
    decimal = choose("decimal", ".", ".", ",") if delimiter != "," else "."
    quote = choose("quote", "no", "no", "yes")
    extra = choose("extra", "none", "none", "words", "comma")
    head = [shown[title] for title in titles]
    if extra == "words":
        head, rows = [*head, "mode"], [(*row, "AUTO") for row in rows]
    elif extra == "comma":
        head = [*head, f'"gain{delimiter} 3D"']
        rows = [(*row, "1.5") for row in rows]
    lines = [
        delimiter.join(f'"{each}"' if quote == "yes" and '"' not in each else each for each in head)
    ]
    if style == "units row":
        below = [f"({units[title]})" if title in units else "" for title in titles]
        lines.append(delimiter.join(below + [""] * (len(head) - len(titles))))
    text_columns = {
        index for index, cells in enumerate(names.values()) if ":" in cells[0] or "-" in cells[0][1:]
    }
    for row in rows:
        cells = [
            cell.replace(".", decimal) if index not in text_columns else cell
            for index, cell in enumerate(row)
        ]
        lines.append(delimiter.join(cells))
    if choose("repeat", "no", "no", "no", "yes") == "yes":
        lines.insert(len(lines) // 2, lines[0])
    if choose("preamble", "no", "no", "no", "comment", "lines") != "no":
        before = {"comment": ["# logger 3, firmware 1.2"], "lines": ["Logger: 3", "Firmware: 1.2"]}
        lines = before[choose("what", "comment", "lines")] + lines
    path = folder / "table.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def imported(path: Path, mapping: Path) -> dict[str, Stream]:
    """Import a table by a mapping."""
    recording = read(path, TableParameters(mapping=str(mapping))).together()
    return {stream.topic: stream for stream in recording.streams}


def judge(drawn: Drawn) -> tuple[Verdict, str]:
    """Say what the guess and the import by it make of a table."""
    mapping = drawn.path.with_suffix(".toml")
    try:
        text = guess([drawn.path])
        mapping.write_text(text, encoding="utf-8")
        streams = imported(drawn.path, mapping)
    except BadInput as error:
        return "refused", str(error)
    finally:
        mapping.unlink(missing_ok=True)
    said = assumptions(text)
    wrong = _compared(drawn, streams)
    if not wrong:
        return "right", ""
    what, how = wrong
    told = [line for line in said if any(word in line for word in STATED[what])]
    return ("assumed" if told else "wrong"), f"{how}; said: {told or said}"


# What an assumption has to speak of that makes up for a fault.
STATED = {
    "date": ("zero", "zone"),
    "scale of time": ("unit",),
    "time": (),
    "place": ("lat",),
    "altitude": ("altitude",),
    "heading": ("heading",),
}


def _compared(drawn: Drawn, streams: Mapping[str, Stream]) -> tuple[str, str] | None:
    """Return what is wrong of a log, or None."""
    truth, rows = drawn.truth, drawn.has_place
    space = "" if drawn.choices["vehicles"] == "one" else "/A"
    if f"{space}/fix" not in streams:
        return "place", f"no fix among {list(streams)}"
    fix = streams[f"{space}/fix"]
    if len(fix) != rows.sum():
        return "place", f"{len(fix)} fixes of {rows.sum()}"
    right_ns = truth.stamps_ns[rows]
    steps = np.diff(fix.publish_time_ns) / np.diff(right_ns)
    off_ns = fix.publish_time_ns - right_ns
    if np.ptp(off_ns) > 2 * TIME_NS:
        kind = "scale of time" if np.ptp(steps) < 0.01 * steps.min() else "time"
        return kind, f"times are {off_ns.min() * 1e-9:.6g} to {off_ns.max() * 1e-9:.6g} s off"
    if drawn.is_absolute and np.abs(off_ns).max() > TIME_NS:
        return "date", f"times are {off_ns.min() * 1e-9:.6g} s off"
    north_m = METRES * (fix["latitude_deg"] - truth.latitude_deg[rows])
    east_m = METRES * (fix["longitude_deg"] - truth.longitude_deg[rows])
    off_m = float(np.hypot(north_m, east_m).max())
    if not off_m < 1.0:
        return "place", f"places are up to {off_m:.4g} m off"
    if drawn.choices["altitude"] != "none":
        off_m = float(np.abs(fix["altitude_m"] - truth.altitude_m[rows]).max())
        if not off_m < 0.1:
            return "altitude", f"altitudes are up to {off_m:.4g} m off"
    if drawn.choices["heading"] != "none" and f"{space}/heading" in streams:
        quaternion = streams[f"{space}/heading"]["quaternion"]
        turned = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])
        off = np.angle(np.exp(1j * (turned - (np.pi / 2 - truth.heading_rad))))
        if np.abs(off).max() > 0.01:
            return "heading", f"headings are up to {np.degrees(np.abs(off).max()):.4g} deg off"
    return None
