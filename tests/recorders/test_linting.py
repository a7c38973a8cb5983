"""What `lint` finds in a log as it is written: the sheet of sensors, section 5.

`python -m tests.recorders.test_linting` counts over 100 seeds what the tests here see in two.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.command_line import main
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.lint import lint
from fuselog.recorders.checks.magnetic import FIELD, units
from fuselog.recorders.checks.names import frames
from fuselog.recorders.log import (
    LogWriter,
    RunMetadata,
    Stream,
    make_stream,
    schemas,
    write_log,
)
from fuselog.recorders.log.impossible import YEAR_NS
from fuselog.recorders.parameters import parse_settings
from fuselog.recorders.recording import import_run, record_run

IMU, FIX, MAG = "/imu", "/fix", "/mag"
BEGIN_NS = 1_700_000_000 * 10**9
Streams = dict[str, Stream]


def clean(seed: int) -> Streams:
    """The sheet's unit at rest, and beside it fixes and a compass that turns once round."""
    rng = np.random.Generator(np.random.Philox(key=900 + seed))
    n = 6000
    t = 0.01 * np.arange(n) + 1e-4 * rng.standard_normal(n)
    force = np.array([0.0, 0.0, 9.81]) + 0.05 * rng.standard_normal((n, 3))
    angle = 2.0 * np.pi * np.arange(600) / 599
    field = np.stack([20.0 * np.cos(angle), -20.0 * np.sin(angle), np.full(600, -40.0)], axis=1)
    stamps_ns = BEGIN_NS + np.rint(1e9 * t).astype(np.int64)
    slow_ns = BEGIN_NS + 10**8 * np.arange(600)
    found = [
        make_stream(
            IMU,
            schemas.INERTIAL_SAMPLE,
            stamps_ns,
            specific_force_mps2=force,
            turn_rate_radps=0.01 * rng.standard_normal((n, 3)),
            magnetic_field_ut=np.empty((n, 0)),
        ),
        make_stream(
            FIX,
            schemas.GEODETIC_FIX,
            slow_ns,
            latitude_deg=49.0 + 1e-6 * rng.standard_normal(600),
            longitude_deg=8.4 + 1e-6 * rng.standard_normal(600),
            altitude_m=115.0 + rng.standard_normal(600),
            covariance_m2=np.tile(np.diag([0.01, 0.01, 1.0]).ravel(), (600, 1)),
        ),
        make_stream(
            MAG,
            schemas.MAGNETIC_FIELD,
            slow_ns,
            magnetic_field_ut=field + 0.3 * rng.standard_normal((600, 3)),
            covariance_ut2=np.tile(0.09 * np.eye(3).ravel(), (600, 1)),
        ),
    ]
    return {each.topic: each for each in found}


def column(topic: str, name: str, change: Callable[[Any], Any]) -> Callable[[Streams], Streams]:
    """One column in place of another; `change` may write into its argument."""

    def put(streams: Streams) -> Streams:
        values = streams[topic][name].copy()
        made = change(values)
        columns = {**streams[topic].columns, name: values if made is None else made}
        return {**streams, topic: replace(streams[topic], columns=columns)}

    return put


def stamps(
    topic: str, change: Callable[[Any], Any], *, logged: bool = True
) -> Callable[[Streams], Streams]:
    """Other stamps, since the begin; of the recorder too, unless its clock is right."""

    def put(streams: Streams) -> Streams:
        own = streams[topic]
        made = BEGIN_NS + np.asarray(change(own.publish_time_ns - BEGIN_NS)).astype(np.int64)
        log_time_ns = made if logged else own.log_time_ns
        return {**streams, topic: replace(own, publish_time_ns=made, log_time_ns=log_time_ns)}

    return put


def rows(topic: str, taken: Callable[[int], Any]) -> Callable[[Streams], Streams]:
    """Some messages of a topic."""
    return lambda streams: {**streams, topic: streams[topic].take(taken(len(streams[topic])))}


def setting(begin: int, end: int, value: float, axis: int | None = None) -> Callable[[Any], None]:
    """Rows of a column, or of one of its axes, are one value."""

    def put(values: Any) -> None:
        values[(slice(begin, end), *([] if axis is None else [axis]))] = value

    return put


def ellipse(x: float, y: float, wide: float) -> Callable[[Any], Any]:
    """A compass on board with iron: another centre, or one axis longer."""
    return lambda field: field * [wide, 1.0, 1.0] + [x, y, 0.0]


def asymmetric(values: Any) -> None:
    """One entry off the diagonal alone."""
    values[:, 1] = 0.005


def indefinite(values: Any) -> None:
    """A correlation above 1."""
    values[:, [1, 3]] = 0.02


def scattered(since_ns: Any) -> Any:
    """Stamps when a busy computer wrote."""
    return since_ns + np.random.default_rng(0).uniform(-3e6, 3e6, len(since_ns)) + 10**8


def saturating(rate: Any) -> None:
    """Turns that a unit of 250 deg/s cannot follow."""
    rate[1000:1400:3, 2] = np.radians(250.0)


def driving(streams: Streams) -> Streams:
    """A drive round a block that climbs: wheels, fixes of two receivers, and places in a plane."""
    n = 600
    t = 0.1 * np.arange(n)
    heading, speed = 0.02 * t, 10.0 + 2.0 * np.sin(0.3 * t)
    at = np.cumsum(0.1 * speed * np.stack([np.cos(heading), np.sin(heading)]), axis=1)
    rng = np.random.default_rng(streams[FIX]["latitude_deg"].view(np.uint64))
    east, north = at + 0.2 * rng.standard_normal((2, n))
    up = 115.0 + 8.0 * np.sin(0.1 * t) + 0.2 * rng.standard_normal(n)
    stamps_ns = streams[FIX].publish_time_ns
    variance = np.tile(0.04 * np.eye(3).ravel(), (n, 1))
    place = {
        "latitude_deg": 49.0 + north / 111_200,
        "longitude_deg": 8.4 + east / (111_200 * np.cos(np.radians(49.0))),
        "covariance_m2": variance,
    }
    twist = np.full(n, 0.02)
    found = [
        make_stream("/odometry", schemas.ODOMETRY, stamps_ns, forward_mps=speed, turn_radps=twist),
        make_stream(FIX, schemas.GEODETIC_FIX, stamps_ns, altitude_m=up, **place),
        make_stream("/second", schemas.GEODETIC_FIX, stamps_ns, altitude_m=up[:] + 0.3, **place),
        make_stream(
            "/place",
            schemas.POSITION_FIX,
            stamps_ns,
            position_m=np.stack([east, north, up - 115.0], axis=1),
            covariance_m2=variance,
        ),
    ]
    return {each.topic: each for each in found}


def exchanged(streams: Streams) -> Streams:
    """A receiver's longitudes for latitudes, beside wheels."""
    streams = {topic: each for topic, each in driving(streams).items() if topic in (FIX, "/odometry")}
    own = streams[FIX].columns
    columns = {**own, "latitude_deg": own["longitude_deg"], "longitude_deg": own["latitude_deg"]}
    return {**streams, FIX: replace(streams[FIX], columns=columns)}


def drifting(streams: Streams) -> Streams:
    """Three minutes by a clock that gains 100 us a second."""
    own = streams[FIX]
    since_ns = 3 * (own.publish_time_ns - BEGIN_NS)
    gained_ns = BEGIN_NS + since_ns + since_ns // 10_000
    return {FIX: replace(own, publish_time_ns=gained_ns, log_time_ns=BEGIN_NS + since_ns)}


def renamed(topic: str, other: str, *, keeps: bool = False) -> Callable[[Streams], Streams]:
    """A topic under another name, or there again under it."""

    def put(streams: Streams) -> Streams:
        rest = {name: each for name, each in streams.items() if keeps or name != topic}
        return {**rest, other: replace(streams[topic], topic=other)}

    return put


def apart(streams: Streams) -> Streams:
    """A car, and of its two receivers one in a namespace of its own."""
    named = {f"/car{topic}": replace(each, topic=f"/car{topic}") for topic, each in streams.items()}
    return renamed("/car/fix", "/gps/fix", keeps=True)(named)


def test_a_field_at_the_ends_of_the_earths_is_the_earths() -> None:
    """In its unit nothing is said, in another one that, and beyond the ends that it is in none."""
    stream = clean(1)[MAG]
    for norm, words in (
        (22.0, ""),
        (67.0, ""),
        (21.9, "is in an unknown unit"),
        (67.1, "is in an unknown unit"),
        (0.22, "is in G"),
        (0.67, "is in G"),
        (0.219, "is in an unknown unit"),
        (0.671, "is in an unknown unit"),
    ):
        level = replace(stream, columns={**stream.columns, FIELD: np.tile([norm, 0.0, 0.0], (600, 1))})
        told = [each.evidence for each in units(level, {})]
        assert [words in each for each in told] == [True] * bool(words), norm


def framed(streams: Streams) -> Streams:
    """A unit whose frame is FRD by its name."""
    return {IMU: replace(streams[IMU], metadata={"frame_id": "base_link_frd"})}


force = partial(column, IMU, "specific_force_mps2")
variance = partial(column, FIX, "covariance_m2")
field = partial(column, MAG, "magnetic_field_ut")
# What is put in: how; then the topic, cause, and the words that are to be said.
FAULTS: Mapping[str, tuple[Callable[[Streams], Streams], str, str, str]] = {
    "stamps in ms, read as s": (stamps(IMU, lambda t: 1000 * t), IMU, "stamps", "too large"),
    "stamps in s, read as ms": (stamps(FIX, lambda t: t // 1000), FIX, "stamps", "too small"),
    "after 2100": (stamps(IMU, lambda t: t + 3 * 10**18), IMU, "stamps", "reach the year"),
    "rows out of order": (
        stamps(IMU, lambda t: t[np.r_[0:50, 51, 50, 52 : len(t)]]),
        IMU,
        "stamps",
        "go back",
    ),
    "rows twice": (rows(IMU, lambda n: np.r_[0:50, 49, 50:n]), IMU, "stamps", "messages are duplicates"),
    "half lost": (
        rows(IMU, lambda n: np.random.default_rng(0).random(n) < 0.5),
        IMU,
        "lost messages",
        "",
    ),
    "jitter": (stamps(IMU, scattered), IMU, "stamps", "steps vary"),
    "clock 2 % fast": (stamps(IMU, lambda t: 1.02 * t, logged=False), IMU, "clock drift", "gains"),
    "leap seconds": (stamps(FIX, lambda t: t + 18 * 10**9, logged=False), FIX, "delay", "18 s ahead of"),
    "TAI": (stamps(FIX, lambda t: t + 37 * 10**9, logged=False), FIX, "delay", "TAI"),
    "time zone": (
        stamps(FIX, lambda t: t - 7200 * 10**9, logged=False),
        FIX,
        "delay",
        "7200 s behind the clock of the recorder: a time zone 2 h",
    ),
    "rate in deg/s": (column(IMU, "turn_rate_radps", lambda w: 57.3 * (w + 1.0)), IMU, "unit", "deg/s"),
    "force in g": (force(lambda f: f / 9.80665), IMU, "gravity", "in g"),
    "force in mg": (force(lambda f: f / 9.80665e-3), IMU, "gravity", "in mg"),
    "z down": (force(lambda f: f * [1, -1, -1]), IMU, "gravity", "z axis is down"),
    "no forces": (force(lambda f: 0.0 * f), IMU, "values", "forces are exactly zero in all"),
    "no turn rates": (
        column(IMU, "turn_rate_radps", lambda w: 0.0 * w),
        IMU,
        "values",
        "turn rates are exactly zero in all",
    ),
    "no field": (field(lambda m: 0.0 * m), MAG, "values", "fields are exactly zero in all 600"),
    "upright": (force(lambda f: f[:, [2, 1, 0]]), IMU, "mounting", "x axis up"),
    "variance -1": (variance(setting(0, 600, -1.0, 0)), FIX, "covariance", "-1"),
    "variance 0": (variance(setting(0, 9, 0.0)), FIX, "covariance", "zero in 9"),
    "variance < 0": (variance(lambda p: -p), FIX, "covariance", "negative"),
    "one number": (variance(setting(0, 600, 1.0)), FIX, "covariance", "one number"),
    "not symmetric": (variance(asymmetric), FIX, "covariance", "not symmetric"),
    "indefinite": (variance(indefinite), FIX, "covariance", "indefinite"),
    "field in G": (field(lambda m: m / 100.0), MAG, "magnetometer", "in G"),
    "field in T": (field(lambda m: m / 1e6), MAG, "magnetometer", "in T"),
    "hard iron": (field(ellipse(8.0, 0.0, 1.0)), MAG, "magnetometer", "hard"),
    "soft iron": (field(ellipse(0.0, 0.0, 1.3)), MAG, "magnetometer", "soft"),
    "latitude 139": (
        column(FIX, "latitude_deg", lambda x: x + 90.0),
        FIX,
        "place",
        "are swapped: a latitude is 139",
    ),
    "at 0, 0": (
        lambda s: column(FIX, "latitude_deg", setting(0, 9, 0.0))(
            column(FIX, "longitude_deg", setting(0, 9, 0.0))(s)
        ),
        FIX,
        "place",
        "9 of 600 fixes are at 0, 0",
    ),
    "integers": (
        column(FIX, "latitude_deg", lambda x: 1e7 * x),
        FIX,
        "place",
        "integers in units of 1e-7",
    ),
    "frozen": (force(setting(100, 300, 0.1, 0)), IMU, "values", "frozen at 0.1 for 200"),
    "saturated": (column(IMU, "turn_rate_radps", saturating), IMU, "values", "end of a range"),
    "clipped": (
        column(IMU, "turn_rate_radps", lambda w: np.clip(w, -0.015, 0.015)),
        IMU,
        "values",
        "its greatest and its least value",
    ),
    "silent": (rows(IMU, lambda n: np.r_[0:3000, 3100:n]), IMU, "gap", "is silent for 1.0"),
    "clock 1e-4 fast": (drifting, FIX, "clock drift", "gains 100 us a second"),
    "wheels, latitude 8": (exchanged, FIX, "place", "swapped: after swapping, fixes move 1"),
    "sea and ellipsoid": (
        lambda s: column("/second", "altitude_m", lambda h: h - 47.0)(driving(s)),
        "/second",
        "place",
        "46.7 m below",
    ),
    "altitudes leap": (
        column(FIX, "altitude_m", lambda h: h + 47.0 * (np.arange(len(h)) % 7 == 3)),
        FIX,
        "place",
        "its altitude leaps 172 times, by up to",
    ),
    "places in NED": (
        lambda s: column("/place", "position_m", lambda p: p[:, [1, 0, 2]] * [1, 1, -1])(driving(s)),
        "/place",
        "sign",
        "its z axis points down (NED)",
    ),
    "a frame's name": (framed, IMU, "name", "means FRD"),
    "raw and again": (
        lambda s: renamed(IMU, "/imu/data", keeps=False)(renamed(IMU, "/imu/data_raw", keeps=True)(s)),
        "/imu/data",
        "name",
        "repeats /imu/data_raw",
    ),
    "own namespace": (apart, "/gps/fix", "name", "alone in its namespace"),
    "rounded": (force(lambda f: np.round(f / 0.2) * 0.2), IMU, "values", "rounded to 0.2"),
}


@cache
def found_of(name: str, seed: int) -> Sequence[Finding]:
    """What is found of a fault that is put in."""
    return lint([FAULTS[name][0](clean(seed))])


def missed(name: str, seed: int) -> str:
    """What is said of a fault that is put in, where it is not what is to be said; else nothing."""
    _, topic, cause, words = FAULTS[name]
    found = found_of(name, seed)
    is_told = any((each.kind, each.where) == (cause, topic) and words in each.evidence for each in found)
    return "" if is_told else f"{name}, seed {seed}: {[each.evidence for each in found]}"


def test_clean_logs_have_no_finding() -> None:
    for seed in (1, 2, 3):
        assert lint([clean(seed)]) == []
    assert lint([driving(clean(1))]) == []


@pytest.mark.paper
@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found(name: str) -> None:
    assert missed(name, 1) == ""


def test_the_page_has_a_row_for_each_fault() -> None:
    page = Path(__file__).parents[2] / "docs" / "lint.md"
    rows = re.findall(r"^\| (.+) \| \d+ \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
    named = {row for row in rows if not row.isdecimal()}
    assert named == {*FAULTS}, "python -m tests.recorders.test_linting measures them"


def test_a_gap_of_years_is_found_where_the_reading_is_portioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The gap is between two portions; what `info` says of the log leaves it out."""
    [imu] = stamps(IMU, lambda t: t + (np.arange(6000) >= 5000) * 20 * YEAR_NS)(
        {IMU: clean(1)[IMU]}
    ).values()
    with LogWriter(tmp_path / "log.mcap") as writer:
        for part in (slice(0, 5000), slice(5000, None)):  # a chunk each
            writer.write([imu.take(part)])
        writer.describe(RunMetadata("test"))
    monkeypatch.setattr("fuselog.replay.engine.streams.linting.BLOCK", 1000)
    monkeypatch.setattr("fuselog.recorders.checks.lint.MOST", 0)
    found = fl.lint(tmp_path / "log.mcap")
    [words] = [each.evidence for each in found if "years" in each.evidence]
    assert words.startswith(
        f"{IMU}: 1000 of its 1000 stamps are years away from those of most messages of the log"
    )
    assert main(["info", str(tmp_path / "log.mcap")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert " 49.9899 s from 2023-11-14 22:13:19 UTC; other messages are years away from these" in said


def test_what_rests_or_is_skewed_is_not_saturated() -> None:
    """Such as a robot that rests where it turns back, and numbers that are mostly the least."""
    path = np.clip(10.0 * np.sin(0.1 * np.arange(600)), -8.0, 8.0)
    skewed = 1.0 + np.floor(np.random.default_rng(4).exponential(5.0, 600))
    for forward, turn in ((path, 0.5 * path), (skewed, skewed[::-1])):
        wheels = make_stream(
            "/odometry",
            schemas.ODOMETRY,
            10**8 * np.arange(600),
            forward_mps=forward,
            turn_radps=turn,
        )
        assert not [each for each in lint([{"/odometry": wheels}]) if "saturated" in each.evidence]


LANDMARKS = fl.record("landmarks", seed=5)
WHEELS, RANGES = "/robot1/odometry", "/robot1/range_bearing"


@pytest.mark.parametrize(
    ("topic", "name", "change", "severity", "words"),
    [
        (
            WHEELS,
            "turn_radps",
            lambda w: np.clip(w, *np.quantile(w, [0.1, 0.9])),
            "hint",
            "is saturated: 240 of 1200 messages are at 0.",
        ),
        (RANGES, "range_m", lambda r: np.where(np.arange(len(r)) % 50, r, -1.0), "likely", "a code"),
        (RANGES, "range_m", lambda r: r - np.quantile(r, 0.001), "hint", "is below zero, down to -0."),
    ],
)
def test_clipped_turns_and_negative_ranges_are_one_finding(
    topic: str, name: str, change: Callable[[Any], Any], severity: str, words: str
) -> None:
    """The robot's speed is constant, so that no other column shows that it moves."""
    assert lint([LANDMARKS.streams]) == []
    [found] = lint([column(topic, name, change)({**LANDMARKS.streams})])
    assert (found.kind, found.where, found.severity) == ("values", topic, severity)
    assert words in found.evidence


def test_rows_that_are_there_twice_are_counted() -> None:
    twice = np.r_[0:50, 49, 50:70, 69, 70:80]
    [found] = [each for each in lint([{IMU: clean(1)[IMU].take(twice)}]) if each.kind == "stamps"]
    assert found.value == 2.0
    assert "2 of its 82 messages are duplicates" in found.evidence


def test_stamps_of_bursts_have_no_rate_of_their_own() -> None:
    """Ten samples get one stamp: they repeat, and their unit is right."""
    [found] = lint([stamps(IMU, lambda t: t // 10**8 * 10**8)(clean(1))])
    assert "have the same stamp as the previous one" in found.evidence
    assert "estimators use the mean of both; deployed and external filters" in found.evidence
    unit = clean(1)[IMU]
    stamps_ns = unit.publish_time_ns // 10**8 * 10**8
    wheels = make_stream(
        "/odometry",
        schemas.ODOMETRY,
        stamps_ns,
        forward_mps=unit["turn_rate_radps"][:, 0],
        turn_radps=unit["turn_rate_radps"][:, 1],
    )
    [found] = lint([{"/odometry": wheels}])
    assert "the first of the two is valid for no time, so it has no effect" in found.evidence


def test_what_is_missing_is_not_frozen() -> None:
    """Of a unit whose gyro stops: its turn rates were still before, and are missing after."""

    def stop(rates: Any) -> None:
        rates[:200], rates[200:] = 0.0, np.nan

    stopping = column(IMU, "turn_rate_radps", stop)
    streams = stopping(clean(1))
    assert not [each for each in lint([streams]) if "frozen" in each.evidence]


def test_a_frames_name_says_how_its_axes_are_turned() -> None:
    for frame, ours, remedy in (
        ("base_link_frd", "forward, left, up", "mounting_deg = [180, 0, 0]"),
        ("odom_ned", "east, north, up", "swap north and east"),
    ):
        [found] = frames(replace(clean(1)[IMU], metadata={"frame_id": frame}), {})
        assert found.evidence.endswith(f"fuselog use {ours}"), frame
        assert remedy in found.otherwise, frame


def test_the_share_that_is_lost_is_the_sheets() -> None:
    streams = {IMU: clean(1)[IMU]}
    rng = np.random.Generator(np.random.Philox(key=901))
    rng.standard_normal(6000), rng.standard_normal((6000, 3))
    [found] = lint([{IMU: streams[IMU].take(rng.random(6000) < 0.5)}])
    assert (found.kind, round(found.value, 6)) == ("lost messages", 0.512641)


@pytest.mark.paper
@pytest.mark.parametrize(("lost", "kinds"), [(0.0, []), (0.2, ["lost messages"])])
def test_a_sensor_that_sees_nothing_for_a_while_has_lost_nothing(lost: float, kinds: list[str]) -> None:
    """The robot sees no landmark for 2.0, 2.4 and 3.0 s; messages lost at random are still found."""
    recording, _ = record_run("landmarks", {"speed_mps": 2.0}, 100, 18)
    [seen] = [each for each in recording.streams if each.topic == "/robot1/range_bearing"]
    stamps = np.unique(seen.publish_time_ns)
    kept = stamps[np.random.default_rng(1).random(len(stamps)) >= lost]
    found = lint([{seen.topic: seen.take(np.isin(seen.publish_time_ns, kept))}])
    assert [each.kind for each in found] == kinds


@pytest.mark.paper
def test_every_setting_that_is_advised_mends_its_finding(tmp_path: Path) -> None:
    """From the file, as the command's --set reads it."""
    advised = 0
    for name, (put, topic, cause, words) in FAULTS.items():
        of_fault = [each for each in found_of(name, 1) if each.kind == cause and words in each.evidence]
        told = [each for each in of_fault if each.setting]
        if not told:
            continue
        path = tmp_path / f"{advised}.mcap"
        write_log(path, list(put(clean(1)).values()), RunMetadata("made", epoch_ns=BEGIN_NS))
        advised += 1
        mended = fl.lint(path, set=parse_settings([told[0].setting]))
        assert not [each for each in mended if each.kind == cause and each.where == topic], name
    assert advised == 14


def imported(folder: Path, stream: Stream, advice: str) -> Stream:
    """A topic written as a table and imported by a mapping that does as it was advised, if it can be."""
    table = pd.DataFrame({"t": stream.publish_time_ns, "logged": stream.log_time_ns})
    fields = {}
    for name in list(stream.columns)[1:]:
        parts = np.reshape(stream[name], (len(stream), -1)).T
        fields[name] = [f"{name}_{index}" for index in range(len(parts))]
        table = table.assign(**dict(zip(fields[name], parts, strict=True)))
    table.to_parquet(folder / "log.parquet", index=False)
    fields = {name: columns for name, columns in fields.items() if columns}
    line = advice.partition(" in the mapping")[0].replace("[SIGMA, ...]", "[0.1, 0.1, 1.0]")
    if "swap the sources of" in advice:
        first, second, *_ = re.findall(r"\w+_deg", advice)
        fields[first], fields[second], line = fields[second], fields[first], ""
    time = 'time = { column = "t", unit = "ns" }'
    if line.startswith("time ="):
        time, line = re.sub(r"column = \.\.\.", 'column = "t", unit = "ns"', line), ""
    given = {name: columns for name, columns in fields.items() if f"deviations.{name}" not in line}
    (folder / "mapping.toml").write_text(
        f'[[tables]]\nfiles = "log.parquet"\n{time}\narrival = {{ column = "logged", unit = "ns" }}\n'
        f'[[tables.streams]]\ntopic = "{stream.topic}"\nbecomes = "{stream.schema.name}"\n'
        + "".join(f"fields.{name} = {json.dumps(columns)}\n" for name, columns in given.items())
        + line
    )
    values = {"mapping": str(folder / "mapping.toml")}
    return import_run("table", folder / "log.parquet", values)[0].streams[0]


@pytest.mark.paper
def test_every_line_of_a_mapping_that_is_advised_mends_its_finding(tmp_path: Path) -> None:
    advised = []
    for name, (put, topic, cause, words) in FAULTS.items():
        told = [each for each in found_of(name, 1) if each.kind == cause and words in each.evidence]
        advice = told[0].otherwise
        if "in the mapping" not in advice or name == "a frame's name":  # whose bag's mapping it is of
            continue
        advised.append(name)
        run = put(clean(1))
        mended = lint([{**run, topic: imported(tmp_path, run[topic], advice)}])
        assert not [each for each in mended if (each.kind, each.where) == (cause, topic)], name
    assert len(advised) == 22


def test_the_command_says_by_its_exit_code_what_it_found(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    good, bad = tmp_path / "good.mcap", tmp_path / "bad.mcap"
    write_log(good, list(clean(1).values()))
    write_log(bad, list(FAULTS["force in g"][0](clean(1)).values()))
    assert (main(["lint", str(good)]), main(["lint", str(tmp_path / "no.mcap")])) == (0, 2)
    capsys.readouterr()
    assert main(["lint", str(bad), "--json"]) == 1
    [found] = json.loads(capsys.readouterr().out)["findings"]
    assert found["setting"] == "/imu.specific_force_scale=9.807"
    assert main(["info", str(bad)]) == 0
    assert "implausible: /imu: specific_force_mps2 is in g" in capsys.readouterr().out


if __name__ == "__main__":
    for seed in range(1, 101):
        for each in lint([clean(seed)]):
            print("clean", seed, each.evidence)
    for name in FAULTS:
        misses = list(filter(None, (missed(name, seed) for seed in range(1, 101))))
        print(f"{name}: {100 - len(misses)} of 100 {misses[:1]}")
