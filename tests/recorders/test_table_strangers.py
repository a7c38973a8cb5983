"""Inputs of the kinds that strangers reported: read right, or refused by a sentence that helps."""

import re
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables import blocks, files
from fuselog.recorders.importers.tables.guessing import assumptions, guess
from fuselog.recorders.importers.tables.importer import TableParameters, read
from fuselog.recorders.log import Stream

ROWS = range(40)
EPOCH = 1_700_000_000


class Got:
    """What came of a table: streams by topic, notes, and what the guess assumed."""

    def __init__(self, path: Path, mapping: str | None = None) -> None:
        text = guess([path]) if mapping is None else mapping
        place = path.parent / "mapping.toml"
        place.write_text(text, encoding="utf-8")
        found = read(path, TableParameters(mapping=str(place))).together()
        self.streams: dict[str, Stream] = {each.topic: each for each in found.streams}
        self.notes, self.said, self.text = found.notes, "; ".join(assumptions(text)), text

    def times(self, topic: str) -> list[str]:
        """The stamps of a topic as text."""
        stamps = self.streams[topic].publish_time_ns
        return [str(pd.Timestamp(each)) for each in stamps.tolist()]


def text_of(folder: Path, head: str, row: Callable[[int], str], rows: Sequence[int] = ROWS) -> Path:
    """Write a table, a line for each row."""
    path = folder / "own.csv"
    path.write_text("\n".join([head, *map(row, rows)]) + "\n", encoding="utf-8")
    return path


# Whole numbers of times.


@pytest.mark.parametrize(
    "kind", ["int64", "uint64", "Int64", "jsonl", "npz", "timestamp", "zoned", "duration", "decimal"]
)
def test_whole_numbers_of_ns_are_times(kind: str, tmp_path: Path) -> None:
    stamps = 1_700_000_000_123_456_789 + 100_000_000 * np.arange(40)
    frame = pd.DataFrame({"stamp": stamps, "speed": 1.5, "yaw_rate": 0.0})
    path = tmp_path / f"own.{kind if kind in ('jsonl', 'npz') else 'parquet'}"
    if kind == "jsonl":
        frame.to_json(path, orient="records", lines=True)
    elif kind == "npz":
        np.savez(path, **{name: frame[name].to_numpy() for name in frame})
    elif kind == "decimal":
        frame["stamp"] = [Decimal(stamp) / 10**9 for stamp in stamps.tolist()]
        frame.to_parquet(path)
    elif kind == "duration":
        frame.assign(stamp=pd.to_timedelta(frame["stamp"])).to_parquet(path)
    elif kind in ("timestamp", "zoned"):
        times = pd.to_datetime(frame["stamp"])
        frame["stamp"] = (
            times if kind == "timestamp" else times.dt.tz_localize("UTC").dt.tz_convert("CET")
        )
        frame.to_parquet(path)
    else:
        frame.astype({"stamp": kind}).to_parquet(path)
    got = Got(path)
    assert got.streams["/odometry"].publish_time_ns.tolist() == stamps.tolist()


def test_no_rate_is_made_up_beside_a_column_that_could_be_a_time(tmp_path: Path) -> None:
    same = text_of(tmp_path, "timestamp,speed,yaw_rate", lambda row: f"{EPOCH},1,{row}")
    with pytest.raises(BadInput, match="could be the time, but is the same in all rows"):
        Got(same)
    tiny = text_of(tmp_path, "time,speed,yaw_rate", lambda row: f"{45000 + row / 86400e3:.11f},1,{row}")
    with pytest.raises(BadInput, match="fit no unit"):
        Got(tiny)
    free = Got(text_of(tmp_path, "speed,yaw_rate", lambda row: f"1,{row}"))
    assert "one row a second" in free.said
    assert "one row a second" in Got(text_of(tmp_path, PLACE, _place)).said


# Order.


@pytest.mark.parametrize(
    ("name", "unit", "bits"),
    [("time_us", "us", 32), ("ms", "ms", 16), ("tick_us", "us", 24), ("time_ms", "ms", 32)],
)
def test_counters_are_continued_beyond_their_rollover(
    name: str, unit: str, bits: int, tmp_path: Path
) -> None:
    step = 10 if bits < 32 else 10_000
    path = text_of(
        tmp_path,
        f"{name},speed,yaw_rate",
        lambda row: f"{(2**bits - 9 * step + step * row) % 2**bits},1,{row}",
    )
    got = Got(path)
    steps = np.diff(got.streams["/odometry"].publish_time_ns)
    assert set(steps.tolist()) == {step * {"us": 1000, "ms": 1_000_000}[unit]}
    assert np.all(np.diff(got.streams["/odometry"]["turn_radps"]) > 0)
    assert f"rolls over at {2**bits}" in got.said
    by_hand = (
        f"[[tables]]\ntime = {{ column = '{name}', unit = '{unit}' }}\n[[tables.streams]]\n"
        "topic = '/v'\nbecomes = 'VectorMeasurement'\nfields.value = ['speed']\ncomponents = 'v'\n"
    )
    with pytest.raises(BadInput, match=f"at row 10 the time falls .*`rollover = {2**bits}`"):
        Got(path, by_hand)


def test_a_clock_with_a_date_that_restarts_is_refused_as_such(tmp_path: Path) -> None:
    path = text_of(tmp_path, "Date,Time,lat,lon", lambda k: f"2025-06-01,10:00:{k % 20:02d},48.1,11.5")
    with pytest.raises(BadInput, match="column Date and Time: at row 21 the time falls"):
        Got(path)


@pytest.mark.parametrize("restart", [20, 33, 38])
def test_a_clock_that_restarts_is_refused(restart: int, tmp_path: Path) -> None:
    path = text_of(tmp_path, "t,speed,yaw_rate", lambda row: f"{0.5 * (row % restart):.1f},1,0.1")
    with pytest.raises(BadInput, match=rf"at row {restart + 1} the time falls .*split the file there"):
        Got(path)


def test_rows_that_are_newest_first_are_reversed(tmp_path: Path) -> None:
    got = Got(text_of(tmp_path, "time,speed,yaw_rate", lambda k: f"2025-06-01 12:00:{59 - k:02d},{k},0"))
    assert got.streams["/odometry"]["forward_mps"].tolist() == list(reversed(ROWS))
    assert "newest first" in got.said
    assert got.notes["own.csv: rows are newest first, so they are reversed"] == "40"


@pytest.mark.parametrize("column", ["vehicle", "device_id", "group"])
def test_several_vehicles_of_a_file_are_told_apart(column: str, tmp_path: Path) -> None:
    """One after the other by any column, of which the times of each rise."""
    path = text_of(
        tmp_path,
        f"t,{column},lat,lon",
        lambda row: f"{EPOCH + row % 20},{'AB'[row // 20]},{48 + 1e-5 * row:.6f},11",
    )
    got = Got(path)
    assert {topic: len(each) for topic, each in got.streams.items()} == {"/A/fix": 20, "/B/fix": 20}
    assert f"{column}: 2 vehicles, each with a namespace" in got.said


# Places.


def row_of_place(lat: str, lon: str, more: str = "") -> Callable[[int], str]:
    return lambda row: f"{EPOCH + row},{lat.format(row)},{lon.format(row)}{more}"


PLACES: dict[str, tuple[str, Callable[[int], str], float, float]] = {
    "semicircles by their names": (
        "t,position_lat,position_long",
        lambda k: f"{EPOCH + k},{598290819 + k},{107670058 + k}",
        50.1481571,
        9.0248000,
    ),
    "semicircles by the speed": (
        "t,lat,lon,speed_mps",
        lambda k: f"{EPOCH + k},{598290819 + 1073 * k},{107670058},10.0",
        50.1481571,
        9.0248000,
    ),
    "1e-7 deg by the speed": (
        "t,lat,lon,speed_mps",
        lambda k: f"{EPOCH + k},{501481679 + 899 * k},{90248083},10.0",
        50.1481679,
        9.0248083,
    ),
    "microdegrees by the speed": (
        "t,lat,lon,speed_mps",
        lambda k: f"{EPOCH + k},{50148168 + 90 * k},{9024808},10.0",
        50.148168,
        9.024808,
    ),
    "microdegrees by their names": (
        "t,lat_e6,lon_e6",
        row_of_place("50148168", "9024808"),
        50.148168,
        9.024808,
    ),
    "a row of units": (
        "t,lat,lon\ns,1e-6 deg,1e-6 deg",
        row_of_place("50148168", "9024808"),
        50.148168,
        9.024808,
    ),
    "south and west": (
        "t,lat,NS,lon,EW",
        lambda k: f"{EPOCH + k},33.{8688 + k},S,70.6,W",
        -33.8688,
        -70.6,
    ),
    "ddmm, south and west": (
        "t,latitude,lat_dir,longitude,lon_dir",
        lambda k: f"{EPOCH + k},3352.12,S,07036.{k:02d},W",
        -33.8686667,
        -70.6,
    ),
    "ddmm near the equator": (
        "t,lat,n_s,lon,e_w",
        lambda k: f"{EPOCH + k},0117.5,N,10351.{k:02d},E",
        1.2916667,
        103.85,
    ),
    "as WKT": ("t,place", lambda k: f"{EPOCH + k},POINT (8.7 47.{50 + k})", 47.5, 8.7),
    "in one cell": ("t,GPS", lambda k: f'{EPOCH + k},"47.{50 + k}, 8.70"', 47.5, 8.7),
    "east of 91 deg": ("t,lat,lon", row_of_place("22.5", "91.{:02d}"), 22.5, 91.0),
}


@pytest.mark.parametrize("name", PLACES)
def test_latitudes_and_longitudes_are_read_in_their_unit(name: str, tmp_path: Path) -> None:
    head, row, latitude, longitude = PLACES[name]
    fix = Got(text_of(tmp_path, head, row)).streams["/fix"]
    assert len(fix) == len(ROWS)
    assert fix["latitude_deg"][0] == pytest.approx(latitude, abs=1e-6)
    assert fix["longitude_deg"][0] == pytest.approx(longitude, abs=1e-6)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("t,lat,lon", lambda k: f"{EPOCH + k},{50148168 + k},{9024808 + k}"),
        ("t,lat,lon", lambda k: f"{EPOCH + k},{4811700 + k},{1152300 + k}"),
        ("t,lat,lon", lambda k: f"{EPOCH + k},48.1,{9.1e9 + k}"),
    ],
)
def test_an_uncertain_unit_of_places_is_refused(
    head: str, row: Callable[[int], str], tmp_path: Path
) -> None:
    with pytest.raises(BadInput, match=r"the unit of lat and lon.*ambiguous.*`units` of latitude_deg"):
        Got(text_of(tmp_path, head, row))


def test_codes_of_ais_are_missing_values(tmp_path: Path) -> None:
    """Each in its own column alone: a longitude of 91 deg is one, and so is a speed of 51.1 kn."""
    path = text_of(
        tmp_path,
        "time,mmsi,lat,lon,sog,cog,heading",
        lambda k: (
            f"2025-06-01 12:00:{k:02d},219000001,"
            + ("91,181,102.3,360,511" if k in (3, 7) else f"55.5,{91 + 8.14e-5 * k:.6f},10.0,90,90")
        ),
    )
    got = Got(path)
    assert len(got.streams["/fix"]) == len(got.streams["/heading"]) == 38
    assert np.abs(got.streams["/fix"]["longitude_deg"] - 91.0).max() < 0.01
    assert got.notes["own.csv: heading: 511, read as missing"] == "2"
    assert "lat: 91 means not available, in 2 rows" in got.said


def test_an_altitude_of_minus_9999_is_missing(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},48.1,11.5,{-9999 if k == 3 else 500}"  # noqa: E731
    got = Got(text_of(tmp_path, "t,lat,lon,alt", row))
    altitude = got.streams["/fix"]["altitude_m"]
    assert np.isnan(altitude[3])
    assert np.nanmin(altitude) == 500
    assert "alt: -9999 means not available, in 1 row" in got.said


def test_a_column_of_codes_alone_gives_nothing(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},219000001,55.5,{11 + 1e-4 * k:.4f},511"  # noqa: E731
    assert set(Got(text_of(tmp_path, "t,mmsi,lat,lon,heading", row)).streams) == {"/fix", "/values"}


def test_altitudes_and_headings_are_read_in_their_unit(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},{481170000 + 900 * k},115000000,{105_000 + k},{100_000 + k}"  # noqa: E731
    got = Got(text_of(tmp_path, "t,lat,lon,height,heading", row))
    assert got.streams["/fix"]["altitude_m"][0] == pytest.approx(105.0)
    half = 0.5 * (np.pi / 2 - np.radians(1.0))
    assert np.abs(got.streams["/heading"]["quaternion"][0, 0]) == pytest.approx(np.cos(half), abs=1e-6)
    high = text_of(tmp_path, "t,lat,lon,altitude", lambda k: f"{EPOCH + k},48,11,{35_000 + k}")
    with pytest.raises(BadInput, match="the unit of altitude, up to 35039, is ambiguous"):
        Got(high)


# Zones and dates.


def by_zone(stated: str) -> str:
    return (
        f"[[tables]]\ntime = {{ column = 'time', unit = 'date'{stated} }}\n[[tables.streams]]\n"
        "topic = '/v'\nbecomes = 'VectorMeasurement'\nfields.value = ['v']\ncomponents = 'v'\n"
    )


def test_the_offset_of_a_cell_comes_first(tmp_path: Path) -> None:
    path = text_of(tmp_path, "time,v", lambda k: f"2025-07-01T12:00:{k:02d}+02:00,{k}")
    for stated in ("", ", zone = 'Europe/Berlin'", ", utc_offset_h = 2"):
        assert Got(path, by_zone(stated)).times("/v")[0] == "2025-07-01 10:00:00"
    with pytest.raises(BadInput, match=r"row 1 holds .*offset from UTC differs from that"):
        Got(path, by_zone(", zone = 'CET'"))


def test_timestamps_without_a_zone_are_local_times(tmp_path: Path) -> None:
    path = tmp_path / "own.parquet"
    local = pd.date_range("2025-07-01 12:00", periods=3, freq="1s")
    for times, stated, stamp in (
        (local, ", zone = 'Europe/Berlin'", "2025-07-01 10:00:00"),
        (local, ", utc_offset_h = -7", "2025-07-01 19:00:00"),
        (local.tz_localize("Europe/Berlin"), ", zone = 'Europe/Berlin'", "2025-07-01 10:00:00"),
    ):
        pd.DataFrame({"time": times, "v": 1.0}).to_parquet(path)
        assert Got(path, by_zone(stated)).times("/v")[0] == stamp


def test_skipped_local_times_are_refused_and_doubled_ones_are_told_by_their_order(
    tmp_path: Path,
) -> None:
    zone = by_zone(", zone = 'America/New_York'")
    path = text_of(tmp_path, "time,v", lambda k: f"2025-03-09 0{1 + k // 20}:{3 * k % 60:02d}:00,{k}")
    with pytest.raises(BadInput, match="row 21 has 2025-03-09 02:00:00, a time that the clocks"):
        Got(path, zone)
    utc = pd.date_range("2025-11-02T04:30Z", periods=40, freq="5min")
    local = utc.tz_convert("America/New_York")
    path = text_of(tmp_path, "time,v", lambda k: f"{local[k]:%Y-%m-%d %H:%M:%S},{k}")
    got = Got(path, zone)
    assert got.streams["/v"].publish_time_ns.tolist() == utc.as_unit("ns").asi8.tolist()
    assert any("the hour that occurs twice in America/New_York" in note for note in got.notes)


def test_rows_an_hour_apart_go_through_the_doubled_hour(tmp_path: Path) -> None:
    utc = pd.date_range("2025-10-25T22:00Z", periods=8, freq="1h")
    local = utc.tz_convert("Europe/Berlin")
    path = text_of(tmp_path, "time,v", lambda k: f"{local[k]:%Y-%m-%d %H:%M:%S},{k}", range(8))
    got = Got(path, by_zone(", zone = 'Europe/Berlin'"))
    assert got.streams["/v"].publish_time_ns.tolist() == utc.as_unit("ns").asi8.tolist()


def test_a_guess_says_that_local_times_are_skipped(tmp_path: Path) -> None:
    head = "time [Europe/Berlin],speed,yaw_rate"
    path = text_of(tmp_path, head, lambda k: f"2025-03-30 0{1 + k // 20}:{3 * k % 60:02d}:00,1,0")
    with pytest.raises(BadInput, match="a time that the clocks of Europe/Berlin skip"):
        Got(path)


def test_continuity_tells_the_day_from_the_month(tmp_path: Path) -> None:
    times = pd.date_range("2019-09-07 22:00", periods=40, freq="10min")
    for pattern in ("%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M", "%d-%m-%y %H:%M", "%y/%m/%d %H:%M"):
        got = Got(text_of(tmp_path, "when,speed,yaw_rate", lambda k, at=pattern: f"{times[k]:{at}},1,0"))
        assert got.times("/odometry")[0] == "2019-09-07 22:00:00", pattern
        assert "first" in got.said
    one_day = text_of(tmp_path, "when,speed,yaw_rate", lambda k: f"07/09/2019 10:{k:02d},1,0")
    with pytest.raises(BadInput, match="may be 9 July 2019 or 7 September 2019"):
        Got(one_day)


def test_dates_without_a_time_of_day_are_dates(tmp_path: Path) -> None:
    days = pd.date_range("2024-01-25", periods=40, freq="1D")
    got = Got(text_of(tmp_path, "when,speed,yaw_rate", lambda k: f"{days[k]:%d/%m/%Y},1,0"))
    assert got.times("/odometry")[-1] == "2024-03-04 00:00:00"


def test_iso_dates_are_certain(tmp_path: Path) -> None:
    got = Got(text_of(tmp_path, "time,speed,yaw_rate", lambda k: f"2025-06-01T12:00:{k:02d}Z,1,0"))
    assert "first" not in got.said
    assert "UTC" not in got.said


@pytest.mark.parametrize(
    ("head", "cells", "stamp"),
    [
        (
            "secs,nsecs",
            lambda k: f"{EPOCH + k // 10},{k % 10 * 100_000_000 + 7}",
            "2023-11-14 22:13:20.000000007",
        ),
        (
            "header.stamp.sec,header.stamp.nanosec",
            lambda k: f"{EPOCH + k},5",
            "2023-11-14 22:13:20.000000005",
        ),
        ("time_s,time_us", lambda k: f"{EPOCH + k},12", "2023-11-14 22:13:20.000012"),
        ("year,month,day,hour,min,sec", lambda k: f"2025,6,1,9,5,{k}.25", "2025-06-01 09:05:00.250000"),
        ("date,utc_time", lambda k: f"010625,0905{k:02d}.50", "2025-06-01 09:05:00.500000"),
        ("week,tow", lambda k: f"2300,{3600 + k}", "2024-02-04 01:00:00"),
        ("week,iTOW", lambda k: f"2300,{3000 + k * 1000}", "2024-02-04 00:00:03"),
        ("GMS,GWk", lambda k: f"{3600000 + k * 1000},2300", "2024-02-04 01:00:00"),
        (
            "Lcl Date,Lcl Time,UTCOfst",
            lambda k: f"2025-06-01,09:05:{k:02d},-07:00",
            "2025-06-01 16:05:00",
        ),
        ("time,utc_offset", lambda k: f"2025-06-01 09:05:{k:02d},-0700", "2025-06-01 16:05:00"),
        ("time,tz", lambda k: f"2025-06-01T09:05:{k:02d}Z,+02:00", "2025-06-01 09:05:00"),
        ("elapsed", lambda k: f"05:{k:02d}.5", "2026-01-01 00:05:00.500000"),
    ],
)
def test_times_in_several_columns_are_together(
    head: str, cells: Callable[[int], str], stamp: str, tmp_path: Path
) -> None:
    got = Got(text_of(tmp_path, f"{head},speed,yaw_rate", lambda k: f"{cells(k)},1,0"))
    assert got.times("/odometry")[0] == stamp


# Text.


TEXTS = {
    "digits at the front": ("t,1RSS(dB),3DFix,lat,lon", "{t},-57,1,48.1,11.5"),
    "units below the names": ("t,lat,lon\n(s),(deg),(deg)", "{t},48.1,11.5"),
    "units without brackets": ("t;lat;lon;mode\ns;deg;deg;", "{t};48.1;11.5;AUTO"),
    "a comma in a name": ('t,"hypot(VX,VY)",lat,lon', "{t},1.5,48.1,11.5"),
    "a comma in the first row": ("t,place,lat,lon", '{t},"Solent, east",48.1,11.5'),
    "a newline in a name": ('t,"speed\nover ground",lat,lon', "{t},1.5,48.1,11.5"),
    "sep=": ("sep=;\nt;lat;lon", "{t};48.1;11.5"),
    "lines above": ("Logger 3\nFirmware 1.2\n\nt,lat,lon", "{t},48.1,11.5"),
    "marks in a text": ("t|lat|lon|note", "{t}|48.1|11.5|a,b;c"),
    "quoted cells": ('"t","lat","lon"', '"{t}","48.1","11.5"'),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_is_read_as_other_readers_read_it(name: str, tmp_path: Path) -> None:
    head, row = TEXTS[name]
    got = Got(text_of(tmp_path, head, lambda k: row.format(t=EPOCH + k)))
    assert len(got.streams["/fix"]) == len(ROWS)
    assert got.streams["/fix"]["latitude_deg"].tolist() == [48.1] * len(ROWS)


def test_repeated_headers_are_no_rows(tmp_path: Path) -> None:
    path = text_of(
        tmp_path, "t,lat,lon", lambda k: f"{EPOCH + k},48.1,11.5" + "\nt,lat,lon" * (k in (5, 20))
    )
    got = Got(path)
    assert len(got.streams["/fix"]) == len(ROWS)
    assert got.notes["own.csv: rows left out, that repeat the names of the columns"] == "2"


def test_lines_are_skipped_and_cells_split_by_the_mapping(tmp_path: Path) -> None:
    path = text_of(tmp_path, "1,2,3\n4,5,6\nt,where,v", lambda k: f"{EPOCH + k},(8.7 47.5),{k}")
    got = Got(
        path,
        "[[tables]]\nskip = 2\nsplit = { where = ['lon', 'lat'] }\ntime = { column = 't' }\n"
        "[[tables.streams]]\ntopic = '/fix'\nbecomes = 'GeodeticFix'\n"
        "fields = { latitude_deg = 'lat', longitude_deg = 'lon' }\n",
    )
    assert got.streams["/fix"]["latitude_deg"].tolist() == [47.5] * len(ROWS)


def test_a_code_of_a_missing_value_holds_in_an_attitude(tmp_path: Path) -> None:
    path = text_of(tmp_path, "t,hdg", lambda k: f"{EPOCH + k},{511 if k == 5 else 90}")
    whole = (
        "[[tables]]\n{table}\ntime = {{ column = 't' }}\nattitude = "
        "{{ heading = 'hdg' }}\n[[tables.streams]]\n"
        "topic = '/heading'\nbecomes = 'Orientation'\n{stream}\n"
        "fields.quaternion = ['quaternion_w', 'quaternion_x', 'quaternion_y', 'quaternion_z']\n"
    )
    for table, stream in (("missing = { hdg = [511] }", ""), ("", "missing = [511]")):
        got = Got(path, whole.format(table=table, stream=stream))
        assert len(got.streams["/heading"]) == len(ROWS) - 1


def test_files_of_one_row_are_one_table(tmp_path: Path) -> None:
    """As KITTI has OXTS: the times and the names of the columns are in files of their own."""
    folder = tmp_path / "oxts"
    (folder / "data").mkdir(parents=True)
    for k in ROWS:
        (folder / "data" / f"{k:010d}.txt").write_text(f"{49 + 1e-6 * k:.6f} 8.4 115.0 {0.1 * k:.1f}")
    stamps = [f"2011-09-26 13:02:{k:02d}.{964389445 + k}" for k in ROWS]
    (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    names = ["lat: latitude (deg)", "lon: longitude (deg)", "alt: altitude (m)", "roll: roll (rad)"]
    (folder / "dataformat.txt").write_text("\n".join(names) + "\n")
    got = Got(folder)
    assert 'file = "timestamps.txt"' in got.text
    assert got.times("/fix") == stamps
    assert got.streams["/fix"]["latitude_deg"][-1] == 49.000039
    (folder / "data" / f"{40:010d}.txt").write_text("49 8.4 115 0")
    with pytest.raises(BadInput, match=r"timestamps.txt: has 40 times, but there are more rows"):
        Got(folder, got.text)


LOCAL = pd.date_range("2025-11-02T04:30Z", periods=40, freq="5min").tz_convert("America/New_York")


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("time,speed,yaw_rate", lambda k: f"2025-06-01 12:00:{59 - k:02d},{k},0"),
        ("time_us,speed,yaw_rate", lambda k: f"{(2**32 - 95_000 + 10_000 * k) % 2**32},{k},0"),
        ("t,vehicle,lat,lon", lambda k: f"{EPOCH + k // 2},{'AB'[k % 2]},{48 + 1e-5 * k:.6f},11"),
        ("t,lat,NS,lon,EW", lambda k: f"{EPOCH + k},3352.{k:02d},S,07036.12,W"),
        ("time [America/New_York],speed,yaw_rate", lambda k: f"{LOCAL[k]:%Y-%m-%d %H:%M:%S},{k},0"),
        ("t,GPS", lambda k: f"{EPOCH + k},47.{50 + k} 8.7" + "\nt,GPS" * (k == 9)),
    ],
)
def test_blocks_make_no_difference_to_what_is_decided_by_order(
    head: str, row: Callable[[int], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = text_of(tmp_path, head, row)
    whole = Got(path)
    for module in (blocks, files):
        monkeypatch.setattr(module, "BLOCK_BYTES", 120)
    parts = Got(path, whole.text)
    assert parts.notes == whole.notes
    for topic, stream in whole.streams.items():
        times = parts.streams[topic].publish_time_ns
        assert sorted(times.tolist()) == stream.publish_time_ns.tolist()
        order = np.argsort(times, kind="stable")
        for name, column in stream.columns.items():
            assert np.array_equal(parts.streams[topic].columns[name][order], column, equal_nan=True)


# Loggers of strangers.

PLACE = "lat,lon"


def _place(row: int, factor: float = 1.0) -> str:
    digits = 7 if factor == 1.0 else 0
    return f"{factor * (47.5 + row * 1e-5):.{digits}f},{factor * (8.5 + row * 2e-5):.{digits}f}"


def test_velocities_are_read_in_the_unit_in_which_places_move(tmp_path: Path) -> None:
    path = text_of(
        tmp_path,
        f"time_boot_ms,{PLACE},vx,vy,vz",
        lambda row: f"{1000 * row},{_place(row, 1e7)},111,150,-3",
    )
    got = Got(path)
    assert got.streams["/velocity"].columns["velocity_mps"][0] == pytest.approx([1.5, 1.11, 0.03])
    assert "along east, north and up" not in got.said


def test_the_accuracy_of_positions_is_no_other_and_has_its_unit(tmp_path: Path) -> None:
    whole = text_of(
        tmp_path, f"t,{PLACE},hAcc", lambda row: f"{EPOCH + row},{_place(row, 1e7)},{1500 + row}"
    )
    assert Got(whole).streams["/fix"].columns["covariance_m2"][0][0] == pytest.approx(2.25)
    phone = text_of(
        tmp_path,
        f"t,bearingAccuracy,horizontalAccuracy,{PLACE}",
        lambda row: f"{EPOCH + row},2,4.5,{_place(row)}",
    )
    assert Got(phone).streams["/fix"].columns["covariance_m2"][0][0] == pytest.approx(20.25)
    mavlink = text_of(tmp_path, f"t,{PLACE},eph", lambda row: f"{EPOCH + row},{_place(row, 1e7)},90")
    with pytest.raises(BadInput, match="the unit of eph, up to 90"):
        Got(mavlink)


def test_axes_are_of_the_sensor_that_the_file_is_named_by(tmp_path: Path) -> None:
    path = text_of(tmp_path, "time,x,y,z", lambda row: f"{EPOCH + 0.01 * row:.2f},0.1,0.2,9.8")
    for name in ("Accelerometer.csv", "Gyroscope.csv"):
        assert set(Got(path.rename(tmp_path / name)).streams) == {"/values"}
        path = tmp_path / name


def test_true_places_keep_their_units(tmp_path: Path) -> None:
    feet = text_of(
        tmp_path,
        f"t,{PLACE},gt_lat,gt_lon,gt_alt_ft",
        lambda row: f"{EPOCH + row},{_place(row)},{_place(row)},1312.3",
    )
    with pytest.raises(BadInput, match="true altitudes, gt_alt_ft, are not in m"):
        Got(feet)

    def minutes(row: int) -> str:
        return f"47{30 + row * 6e-4:08.5f},8{30 + row * 1.2e-3:08.5f}"

    both = text_of(
        tmp_path,
        f"t,{PLACE},gt_lat,gt_lon",
        lambda row: f"{EPOCH + row},{minutes(row)},{minutes(row)}",
    )
    got = Got(both)
    assert got.streams["/fix"].columns["latitude_deg"][0] == pytest.approx(47.5)
    assert np.abs(got.streams["/truth"].columns["state"][-1]).max() < 100
    assert "agree with the speed" not in got.said


def test_times_of_fit_count_from_1989(tmp_path: Path) -> None:
    path = text_of(
        tmp_path,
        "timestamp,position_lat,position_long",
        lambda row: f"{1069034400 + row},{566697074 + 100 * row},{101408950 + 200 * row}",
    )
    assert Got(path).times("/fix")[0] == "2023-11-16 02:00:00"
    text = path.read_text(encoding="utf-8").replace(
        "timestamp,position_lat", "r.timestamp[s],r.position_lat"
    )
    path.write_text(text, encoding="utf-8")
    assert Got(path).times("/fix")[0] == "2023-11-16 02:00:00"


def test_an_orientation_that_its_covariance_denies_is_none(tmp_path: Path) -> None:
    names = ",".join(f"field.orientation.{axis}" for axis in "xyzw")
    head = f"%time,{names},field.orientation_covariance0,speed"
    path = text_of(tmp_path, head, lambda row: f"{(EPOCH + row) * 10**9},0,0,0,1,-1,{row}")
    assert set(Got(path).streams) == {"/values"}


@pytest.mark.parametrize(
    ("latitude", "longitude", "why"),
    [(47.5, 351.5, "seem to be from 0 to 360 deg"), (151.2, -33.8, "no unit fits")],
)
def test_degrees_beyond_their_range_are_no_degrees_and_minutes(
    latitude: float, longitude: float, why: str, tmp_path: Path
) -> None:
    path = text_of(
        tmp_path, f"t,{PLACE}", lambda row: f"{EPOCH + row},{latitude + row / 1e5:.5f},{longitude}"
    )
    with pytest.raises(BadInput, match=why):
        Got(path)


def test_thousandths_of_degrees_a_second_are_known(tmp_path: Path) -> None:
    names = [
        f"{name}_{axis} [{unit}]" for name, unit in (("acc", "mg"), ("gyro", "mdps")) for axis in "xyz"
    ]
    path = text_of(tmp_path, f"t,{','.join(names)}", lambda row: f"{EPOCH + row},0,0,1000,100,200,300")
    found = Got(path).streams["/inertial"].columns["turn_rate_radps"][0]
    assert np.degrees(found) == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize(("name", "begin"), [("utc", 20), ("time", 50)])
def test_few_seconds_of_hhmmss_are_no_counter(name: str, begin: int, tmp_path: Path) -> None:
    def clock(row: int) -> str:
        return f"2213{begin + row:02d}" if begin + row < 60 else f"2214{begin + row - 60:02d}"

    path = text_of(
        tmp_path, f"{name},speed,yaw_rate", lambda row: f"{clock(row)},1,0", range(30 - begin // 3)
    )
    assert Got(path).times("/odometry")[0] == f"2026-01-01 22:13:{begin}"


# Forms of other programs.

VBO = """File created on 05/07/2019 at 13:45:12

[header]
satellites
time
latitude
longitude
velocity kmh
heading
height

[comments]
(c)2001 2004 Racelogic

[column names]
sats time lat long velocity heading height

[data]
"""


def test_places_of_a_vbo_are_minutes_to_the_north_and_west(tmp_path: Path) -> None:
    rows = [
        f"007 1245{12 + 0.1 * k:05.2f} +{3119.0973 + 0.001 * k:.5f} +00058.4928 040.200 033.00 +0112.44"
        for k in ROWS
    ]
    path = tmp_path / "lap.vbo"
    path.write_text(VBO + "\n".join(rows) + "\n", encoding="utf-8")
    got = Got(path)
    fix = got.streams["/fix"]
    assert fix["latitude_deg"][0] == pytest.approx(51.984955)
    assert fix["longitude_deg"][0] == pytest.approx(-0.97488)
    assert got.times("/fix")[:2] == ["2026-01-01 12:45:12", "2026-01-01 12:45:12.100000"]
    assert "minutes that are positive to the west" in got.said
    path.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(BadInput, match=r"has no sections \[column names\] and \[data\]"):
        Got(path)


def test_a_table_of_messages_of_several_kinds_is_refused(tmp_path: Path) -> None:
    head = "Type,Local Number,Message,Field 1,Value 1,Units 1,Field 2,Value 2,Units 2"
    for names, row in (
        (head, "Data,0,record,timestamp,{},s,position_lat,598290819,semicircles".format),
        ("time,name,value", lambda k: f"{EPOCH + k},{'speed' if k % 2 else 'yaw_rate'},0.1"),
        ("time,sensor,x,y,z", lambda k: f"{EPOCH + k},{'acc' if k % 2 else 'gyro'},1,2,3"),
    ):
        with pytest.raises(BadInput, match=r"holds messages of several kinds.*--data record"):
            Got(text_of(tmp_path, names, row))


@pytest.mark.parametrize(
    ("head", "row", "stamp"),
    [
        ("value,a", lambda k: f"{5 + k % 3},{EPOCH + k}", "2023-11-14 22:13:20"),
        ("a,value", lambda k: f"{k % 3},{(EPOCH + 40 - k) * 1000}", "2023-11-14 22:13:21"),
        ("value,var2", lambda k: f"{k % 3},{0.01 * k:.2f}", "could be the time"),
        ("value,time", lambda k: f"{k % 3},12h30m{k:02d}s", "in an unknown format"),
    ],
)
def test_what_could_be_a_time_stops_a_made_up_rate(
    head: str, row: Callable[[int], str], stamp: str, tmp_path: Path
) -> None:
    path = text_of(tmp_path, head, row)
    if stamp.startswith("2023"):
        assert Got(path).times("/values")[0] == stamp
    else:
        with pytest.raises(BadInput, match=stamp):
            Got(path)


# Axes.


@pytest.mark.parametrize(
    ("file", "head"),
    [
        ("log_1_vehicle_local_position_0.csv", "t,x,y,z,vx,vy,vz"),
        ("own.csv", "t,x_ned,y_ned,z_ned,vx_ned,vy_ned,vz_ned"),
        ("own.csv", "t,north,east,down,vel_n_m_s,vel_e_m_s,vel_d_m_s"),
        ("own.csv", "t,PN,PE,PD,VN,VE,VD"),
    ],
)
def test_axes_of_north_east_down_are_told_by_their_names(file: str, head: str, tmp_path: Path) -> None:
    path = text_of(tmp_path, head, lambda k: f"{EPOCH + k},{2 * k},{k},{-3 * k},2,1,-3")
    got = Got(path.rename(tmp_path / file))
    assert got.streams["/position"]["position_m"][1].tolist() == [1, 2, 3]
    assert got.streams["/velocity"]["velocity_mps"][1].tolist() == [1, 2, 3]
    assert "along east" not in got.said


def test_velocities_without_a_fix_are_left_out(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},{3 * (k > 2)},{_place(k)},2,1,-3"  # noqa: E731
    assert (
        len(Got(text_of(tmp_path, f"t,gpsFix,{PLACE},velN,velE,velD", row)).streams["/velocity"]) == 37
    )


def test_a_yaw_along_the_course_is_clockwise_from_north(tmp_path: Path) -> None:
    """Both ways are near the course of 53 deg, and one of them is it."""
    row = lambda k: f"{EPOCH + k},{_place(k)},53.4"  # noqa: E731
    assert "Yaw: clockwise from north" in Got(text_of(tmp_path, f"t,{PLACE},Yaw", row)).said


def test_columns_of_a_track_are_no_targets_and_no_hemispheres(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},{_place(k)},{2 * k},53,S"  # noqa: E731
    got = Got(text_of(tmp_path, f"t,{PLACE},distance,bearing,study", row))
    assert set(got.streams) == {"/fix", "/values"}
    assert got.streams["/fix"]["latitude_deg"][0] == pytest.approx(47.5)


def test_a_date_without_a_name_is_of_the_time_beside_it(tmp_path: Path) -> None:
    row = lambda k: f"MSG,{k % 4},2025/06/01,10:00:{k:02d}.123,50.5"  # noqa: E731
    path = text_of(tmp_path, row(0), row, ROWS[1:])
    assert Got(path).times("/values")[0] == "2025-06-01 10:00:00.123000"


def test_axes_that_nothing_names_are_assumed(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},{2 * k},{k},{-3 * k}"  # noqa: E731
    for head in ("t,x,y,z", "t,gt_x,gt_y,gt_z"):
        assert ": along east, north and up" in Got(text_of(tmp_path, head, row)).said
    assert "along east" not in Got(text_of(tmp_path, "t,x_enu,y_enu,z_enu", row)).said


def test_places_of_an_origin_are_no_fixes(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},48.1,11.5,{2 * k},{k},{-3 * k}"  # noqa: E731
    assert set(Got(text_of(tmp_path, "t,ref_lat,ref_lon,x,y,z", row)).streams) == {
        "/position",
        "/values",
    }


# Rows without a fix.


@pytest.mark.parametrize(
    ("head", "none", "fix"),
    [
        ("field.status.status", "-1", "0"),
        ("fixType", "0", "3"),
        ("fix_type", "1", "4"),
        ("gps_qual", "0", "1"),
        ("gnssFixOK", "0", "1"),
        ("gps_mode", "1", "3"),
        ("class,mode", "TPV,1", "TPV,3"),
        ("NSats,Status", "9,1", "9,4"),
        ("status", "V", "A"),
        ("fix", "none", "3d"),
    ],
)
def test_rows_that_say_that_they_have_no_fix_are_left_out(
    head: str, none: str, fix: str, tmp_path: Path
) -> None:
    path = text_of(
        tmp_path,
        f"t,{head},lat,lon",
        lambda k: (
            f"{EPOCH + k},{none},0.5,11.5" if k < 3 else f"{EPOCH + k},{fix},{48 + k * 1e-5:.5f},11.5"
        ),
    )
    got = Got(path)
    assert got.streams["/fix"]["latitude_deg"].min() > 48
    assert "no fix in 3 rows" in got.said
    assert got.notes["/fix: messages left out: not chosen by its 'where'"] == "3"
    assert got.notes["origin"].startswith("48.00003, 11.5 deg")


# Several times, zones, weeks, units.


def test_the_stamp_of_the_header_is_the_time(tmp_path: Path) -> None:
    path = text_of(
        tmp_path,
        "%time,field.header.stamp,field.latitude,field.longitude",
        lambda k: f"{(EPOCH + k) * 10**9 + 5 * 10**8},{(EPOCH + k) * 10**9},48.1,11.5",
    )
    got = Got(path)
    assert got.times("/fix")[0] == "2023-11-14 22:13:20"
    assert "field.header.stamp: the time of the measurement, not time" in got.said


@pytest.mark.parametrize(("late", "early"), [("Z", ""), ("", "+02:00"), (" EST", "")])
def test_rows_of_which_some_state_a_zone_need_one_for_the_others(
    late: str, early: str, tmp_path: Path
) -> None:
    path = text_of(
        tmp_path,
        "time,lat,lon",
        lambda k: f"2025-06-01 12:00:{k:02d}{late if k > 20 else early},48.1,11.5",
    )
    with pytest.raises(BadInput, match=r"row \d+ holds '2025-06-01 12:00:\d\d' without a zone"):
        Got(path)
    with pytest.raises(BadInput, match='zone = "UTC"'):
        Got(path, BY_TIME.replace("TIME", '{ column = "time", unit = "date" }'))
    stated = '{ column = "time", unit = "date", zone = "UTC", order = "any" }'
    assert len(Got(path, BY_TIME.replace("TIME", stated)).streams["/v"]) == 40


BY_TIME = (
    "[[tables]]\ntime = TIME\n[[tables.streams]]\ntopic = '/v'\nbecomes = 'VectorMeasurement'\n"
    "fields.value = ['lat']\ncomponents = 'v'\n"
)


def test_a_gps_week_of_ten_bits_needs_the_date_of_week_0(tmp_path: Path) -> None:
    path = text_of(tmp_path, "week,tow,lat,lon", lambda k: f"300,{345600 + k},48.1,11.5")
    with pytest.raises(BadInput, match=r"GPS week 300 .*`zero`"):
        Got(path)
    time = '{ column = "tow", week = "week"%s }'
    with pytest.raises(BadInput, match=r"GPS week 300 .*`zero`"):
        Got(path, BY_TIME.replace("TIME", time % ""))
    got = Got(path, BY_TIME.replace("TIME", time % ', zero = "2019-04-07"'))
    assert got.times("/v")[0] == "2025-01-09 00:00:00"


def test_units_of_names_are_used_or_told(tmp_path: Path) -> None:
    row = lambda k: f"{EPOCH + k},36,0,0,0,0,10"  # noqa: E731
    names = ",".join(
        f"{of}_{axis}_{unit}" for of, unit in (("linear", "kmh"), ("angular", "deg")) for axis in "xyz"
    )
    twist = Got(text_of(tmp_path, f"t,{names}", row)).streams["/twist"]
    assert twist["velocity_mps"][0].tolist() == [10, 0, 0]
    assert np.degrees(twist["turn_rate_radps"][0]) == pytest.approx([0, 0, 10])
    row = lambda k: f"{EPOCH + k},5,0.1"  # noqa: E731
    assert (
        "'furlong/h' is not a known unit"
        in Got(text_of(tmp_path, "t,speed [furlong/h],yaw_rate", row)).said
    )
    assert set(Got(text_of(tmp_path, "t,engine_speed [rpm],yaw_rate", row)).streams) == {"/values"}


@pytest.mark.parametrize(
    ("cell", "stamp"),
    [
        ("07-Sep-2019 12:00:{:02d}", "2019-09-07 12:00:00"),
        ('"September 7, 2019 01:00:{:02d} PM"', "2019-09-07 13:00:00"),
        ("45000.{:05d}", "Excel"),
    ],
)
def test_months_have_names_and_days_are_no_times(cell: str, stamp: str, tmp_path: Path) -> None:
    path = text_of(tmp_path, "time,lat,lon", lambda k: f"{cell.format(k)},48.1,11.5")
    if stamp.startswith("2019"):
        assert Got(path).times("/fix")[0] == stamp
    else:
        with pytest.raises(BadInput, match=stamp):
            Got(path)


def test_a_date_that_cannot_be_read_is_not_passed_over(tmp_path: Path) -> None:
    path = text_of(tmp_path, "date,time,lat,lon", lambda k: f"7. Sept. 19,12:00:{k:02d},48.1,11.5")
    with pytest.raises(BadInput, match=r"date dates such as '7. Sept. 19' in an unknown format"):
        Got(path)
    offsets = text_of(tmp_path, "time,utc_offset,lat", lambda k: f"2025-06-01 12:00:{k:02d},2h,48.1")
    with pytest.raises(BadInput, match="column utc_offset states offsets from UTC such as '2h'"):
        Got(offsets)
    degrees = text_of(tmp_path, "time,lat,lon", lambda k: f"{EPOCH + k},52°12'{k}\"N,11°24'{k}\"E")
    with pytest.raises(BadInput, match="column lat holds places such as '52°12'0\"N'"):
        Got(degrees)


# Files of devices that are known by their names or form.


def _clock(row: int) -> str:
    return f"2026-05-03T10:00:{row:02d}"


def _inspva(row: int) -> str:
    place = f"2417,{36000 + row}.0,{48.1 + row * 1e-5:.7f},11.5,500.1,1.1,0.0,0.01,0.1,0.3,0.0"
    status = "INS_ALIGNING" if row < 5 else "INS_SOLUTION_GOOD"
    return f"#INSPVAA,COM1,0,50.0,FINESTEERING,2417,{36000 + row}.0,0,0,1;{place},{status}*12ab34cd\n"


VBOX_HEAD = "satellites,time,latitude,longitude,velocity kmh,heading,height\n"
# What a file holds, and the first fix by the guess: its stamp, latitude and longitude.
DEVICES = {
    "vbox.csv": (
        VBOX_HEAD
        + "".join(f"9,{100000 + row},{2886 + row / 1e3:.5f},-690.0,4.0,0,500\n" for row in ROWS),
        ("2026-01-01 10:00:00", 48.1, 11.5),
    ),
    "flysight.csv": (
        "$FLYS,1\n$VAR,FIRMWARE_VER,v2023.09.22\n$COL,GNSS,time,lat,lon,hMSL\n$UNIT,GNSS,,deg,deg,m\n$DATA\n"
        + "".join(f"$GNSS,{_clock(row)}.00Z,{48.1 + row * 1e-5:.7f},11.5,500\n" for row in ROWS),
        ("2026-05-03 10:00:00", 48.1, 11.5),
    ),
    "novatel.asc": (
        "".join(f"#BESTPOSA,COM1,0,1;SOL_COMPUTED,1.0,2.0*00000000\n{_inspva(row)}" for row in ROWS),
        ("2026-05-03 10:00:05", 48.10005, 11.5),
    ),
    "androsensor.csv": (
        "LOCATION Latitude : ;LOCATION Longitude : ;Time since start in ms ;YYYY-MO-DD HH-MI-SS_SSS\n"
        + "".join(
            f"{48.1 + row * 1e-5:.6f};11.5;{500 * row};2016-06-02 13-00-{row:02d}_083\n" for row in ROWS
        ),
        ("2016-06-02 13:00:00.083000", 48.1, 11.5),
    ),
    "day of year.txt": (
        "year doy hour minute second lat lon\n"
        + "".join(f"2026 123 10 0 {row} {48.1 + row * 1e-5:.6f} 11.5\n" for row in ROWS),
        ("2026-05-03 10:00:00", 48.1, 11.5),
    ),
    "ordinal.csv": (
        "time,lat,lon\n"
        + "".join(f"2026-123T10:00:{row:02d}Z,{48.1 + row * 1e-5:.6f},11.5\n" for row in ROWS),
        ("2026-05-03 10:00:00", 48.1, 11.5),
    ),
    "letters.csv": (
        "time,lat,lon\n" + "".join(f"{_clock(row)}Z,{48.1 + row * 1e-5:.6f}S,W 11.5°\n" for row in ROWS),
        ("2026-05-03 10:00:00", -48.1, -11.5),
    ),
    "ddmm letters.csv": (
        "time,lat,lon\n" + "".join(f"{_clock(row)}Z,4806.{row:04d}N,01130.0000W\n" for row in ROWS),
        ("2026-05-03 10:00:00", 48.1, -11.5),
    ),
}


@pytest.mark.parametrize("name", DEVICES)
def test_files_of_devices_are_read_in_their_units(name: str, tmp_path: Path) -> None:
    text, (stamp, latitude, longitude) = DEVICES[name]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    got = Got(path)
    fix = got.streams["/fix"]
    assert got.times("/fix")[0] == stamp
    assert fix["latitude_deg"][0] == pytest.approx(latitude)
    assert fix["longitude_deg"][0] == pytest.approx(longitude)
    assert np.ptp(fix["latitude_deg"]) > 1e-5


@pytest.mark.parametrize(("step", "seconds"), [(100, 1e-4), (25, 1e-4), (10_000, 1e-4), (16_667, 1e-6)])
def test_the_counter_of_xsens_has_ticks_of_its_own(step: int, seconds: float, tmp_path: Path) -> None:
    begin = 2**32 - 20 * step
    head = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    got = Got(
        text_of(tmp_path, head, lambda row: f"{row},{(begin + row * step) % 2**32},0,0,9.81,0,0,0.1")
    )
    steps_ns = np.diff(got.streams["/inertial"].publish_time_ns)
    assert steps_ns.tolist() == [round(step * seconds * 1e9)] * 39


def test_tables_of_ardupilot_have_one_clock_and_its_codes_and_axes(tmp_path: Path) -> None:
    (tmp_path / "gps.csv").write_text(
        "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U\n"
        + "".join(
            f"{10**8 + 200_000 * row},3,{220_000_000 + 200 * row},2288,14,0.8,{48.1 + row * 1e-5:.7f},"
            "11.5,500,5.5,0,0,0,1\n"
            for row in ROWS
        )
    )
    (tmp_path / "imu.csv").write_text(
        "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ\n"
        + "".join(f"{10**8 + 2500 * row},0,0,0.1,0.2,0,-9.8\n" for row in ROWS)
    )
    got = Got(tmp_path)
    inertial = got.streams["/imu/inertial"]
    assert got.streams["/gps/fix"].publish_time_ns[0] == inertial.publish_time_ns[0]
    np.testing.assert_allclose(inertial["specific_force_mps2"][0], [0.2, 0, 9.8], atol=1e-12)
    np.testing.assert_allclose(inertial["turn_rate_radps"][0], [0, 0, -0.1], atol=1e-12)
    assert "Yaw: 0 means not available, in 40 rows" in got.said
    assert not any(topic.endswith("/heading") for topic in got.streams)


# Tables without a time that is known, and what the refusal says.
TIMELESS = {
    "frame,id,x,y": 'column = "frame", rate_hz = 25 } for 25 a second, and in the table vehicle = "id"',
    "recordingId,trackId,frame,trackLifetime,xCenter,yCenter": 'vehicle = "trackId"',
    "id,x,y": "no column could be the time of the rows of several vehicles, by column id",
    "YEAR,DOY,SOD,lat,lon": "columns DOY, YEAR hold the date in parts",
    "year,day_of_year,seconds_of_day,lat,lon": "hold the date in parts",
    "time,lat,lon": "neither a date since 1970 nor less than a year",
}


@pytest.mark.parametrize("head", TIMELESS)
def test_a_table_without_a_known_time_is_refused(head: str, tmp_path: Path) -> None:
    of_name = {
        "frame": lambda row: row % 20, "trackLifetime": lambda row: row % 20,
        "id": lambda row: row // 20, "trackId": lambda row: row // 20,
        "YEAR": lambda _: 2026, "year": lambda _: 2026, "DOY": lambda _: 123,
        "day_of_year": lambda _: 123, "recordingId": lambda _: 7,
        "time": lambda row: 3_800_000_000 + row,
    }  # fmt: skip
    names = head.split(",")
    path = text_of(
        tmp_path,
        head,
        lambda row: ",".join(str(of_name.get(name, lambda row: 36 + row)(row)) for name in names),
    )
    with pytest.raises(BadInput, match=re.escape(TIMELESS[head])):
        Got(path)


def test_a_mapping_states_the_rate_of_frames(tmp_path: Path) -> None:
    path = text_of(tmp_path, "frame,id,x,y", lambda row: f"{5 + row % 20},{row // 20},{row},0")
    got = Got(
        path,
        '[[tables]]\nfiles = "own.csv"\nvehicle = "id"\ntime = { column = "frame", rate_hz = 25 }\n'
        '[[tables.streams]]\ntopic = "/{vehicle}/position"\nbecomes = "PositionFix"\n'
        'fields = { position_m = ["x", "y"] }\n',
    )
    for topic in ("/0/position", "/1/position"):
        stamps_ns = got.streams[topic].publish_time_ns
        assert stamps_ns.tolist() == [(5 + row) * 40_000_000 for row in range(20)]


def test_a_clock_that_was_never_set_counts_from_1970(tmp_path: Path) -> None:
    path = text_of(
        tmp_path,
        "TIMESTAMP,TRACK_ID,X,Y",
        lambda row: f"{315_969_904.25 + 0.1 * (row // 2):.3f},{'ab'[row % 2]},{row},0",
    )
    got = Got(path)
    assert got.times("/a/position")[0] == "1980-01-06 01:25:04.250000"
    assert "by a clock that was never set" in got.said


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("raw.nmea", "$GPGGA,100000.00,4806.1000,N,01130.2000,E,1,08,0.9,545.4,M,46.9,M,,*47\n", "NMEA"),
        ("log.asc", "#BESTPOSA,COM1,0,1;SOL_COMPUTED,1.0,2.0*00000000\n", "has no rows of INSPVAA"),
        ("sensor.csv", "$FLYS,1\n$COL,IMU,time,wx,wy,wz\n$DATA\n$IMU,1,2,3,4\n", "without GNSS rows"),
        (
            "dms.csv",
            "time,lat,lon\n2026-05-03 10:00:00,48°06'01\"N,11°30'02\"E\n",
            "convert them to degr",
        ),
    ],
)
def test_other_logs_of_receivers_are_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(BadInput, match=words):
        Got(tmp_path / name)
