"""Tables as strangers write them: read right, or refused, or under an assumption that is stated."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.recorders.checks.lint import lint
from tests.recorders.strange_tables import draw, imported, judge


@pytest.mark.paper
def test_no_table_is_read_wrongly_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    verdicts, wrong = Counter[str](), []
    for _ in range(40):
        drawn = draw(tmp_path, rng)
        verdict, why = judge(drawn)
        drawn.path.unlink()
        verdicts[verdict] += 1
        wrong += [f"{drawn.choices}: {why}"] if verdict == "wrong" else []
    with capsys.disabled():
        print(f"\ntables read right without a question: {verdicts['right']} of 40")
    assert not wrong
    assert verdicts["right"] >= 36


STAMPS_S = 1_700_000_000 + 0.5 * np.arange(400)
COURSE = 0.3 + 0.4 * np.sin(0.05 * np.arange(400))  # clockwise from north
NORTH = np.cumsum(5.0 * np.cos(COURSE))
LATITUDE = 52.1 + NORTH / 111_195
LONGITUDE = 6.4 + np.cumsum(5.0 * np.sin(COURSE)) / 111_195 / np.cos(np.radians(52.1))
SPEED = np.full(400, 10.0)
FIX = (
    "topic = '/fix'\nbecomes = 'GeodeticFix'\n"
    "fields = { latitude_deg = 'lat', longitude_deg = 'lon', altitude_m = 'alt' }"
)
ODOMETRY = (
    "topic = '/odometry'\nbecomes = 'Odometry'\nfields = { forward_mps = 'speed', turn_radps = 'turn' }"
)
HEADING = (
    "topic = '/heading'\nbecomes = 'Orientation'\n"
    "fields.quaternion = ['quaternion_w', 'quaternion_x', 'quaternion_y', 'quaternion_z']"
)
COLUMNS = {
    "t": STAMPS_S, "lat": LATITUDE, "lon": LONGITUDE, "alt": np.full(400, 105.0), "speed": SPEED,
    "turn": -np.gradient(COURSE, 0.5), "heading": np.degrees(COURSE), "id": np.zeros(400),
}  # fmt: skip
SAMPLES = (
    "topic = '/inertial'\nbecomes = 'InertialSample'\n"
    "fields = { specific_force_mps2 = ['ax', 'ay', 'az'], turn_rate_radps = ['gx', 'gy', 'gz'] }"
)
INERTIAL = {name: np.zeros(400) for name in ("ax", "ay", "gx", "gy")}
INERTIAL |= {"az": np.full(400, 9.81), "gz": COLUMNS["turn"]}
SCALED = "units = { latitude_deg = '1e-7 deg', longitude_deg = '1e-7 deg' }"


def _ddmm(values: np.ndarray) -> np.ndarray:
    return 100 * np.floor(values) + 60 * (values % 1)


def _linted(folder: Path, columns: dict[str, Any], table: str, *streams: str) -> str:
    """What lint says of columns by a mapping that is written by hand."""
    path, mapping = folder / "own.csv", folder / "own.toml"
    pd.DataFrame({**COLUMNS, **columns}).to_csv(path, index=False)
    stream = "".join(f"[[tables.streams]]\n{each}\n" for each in streams)
    mapping.write_text(f"[[tables]]\nfiles = 'own.csv'\n{table}\n{stream}")
    return "\n".join(each.sentence for each in lint([imported(path, mapping)]))


TIME = "time = { column = 't' }"
ZEROS = "its fixes are near latitude 0, longitude 0"
ATTITUDE = "attitude = { heading = 'heading'"
DAYS = [f"{7 + k // 100:02d}/09/2019 10:{k // 2 % 50:02d}:{k % 2 * 30:02d}" for k in range(400)]
# Other columns, the head of the table, its streams, and what lint says.
WRONG: dict[str, tuple[dict[str, Any], str, list[str], str]] = {
    "a rate": ({}, "time = { rate_hz = 20, zero = '2026-01-01' }", [FIX, ODOMETRY], "speed|forward_mps"),
    "semicircles": (
        {"lat": LATITUDE / 180 * 2**31, "lon": LONGITUDE / 180 * 2**31},
        TIME,
        [f"{FIX}\n{SCALED}", ODOMETRY],
        "are semicircles read as 1e-7 deg",
    ),
    "microdegrees": (
        {"lat": 1e6 * LATITUDE, "lon": 1e6 * LONGITUDE},
        TIME,
        [f"{FIX}\n{SCALED}", ODOMETRY],
        "/fix moves 0.1",
    ),
    "ddmm as 1e-7": (
        {"lat": _ddmm(LATITUDE), "lon": _ddmm(LONGITUDE)},
        TIME,
        [f"{FIX}\n{SCALED}"],
        ZEROS,
    ),
    "ddmm as degrees": (
        {"lat": _ddmm(LATITUDE) / 100, "lon": _ddmm(LONGITUDE) / 100},
        TIME,
        [FIX, ODOMETRY],
        "degrees and minutes, ddmm.mmmm, read as degrees",
    ),
    "a code": ({"lat": np.where(np.arange(400) == 9, 91, LATITUDE)}, TIME, [f"{FIX}\n{SCALED}"], ZEROS),
    "mm": ({"alt": np.full(400, 105_000)}, TIME, [FIX], "altitudes are beyond"),
    "1e-5 deg": (
        {"heading": np.rint(1e5 * np.degrees(COURSE + 0.01 * np.sin(np.arange(400))))},
        f"{TIME}\n{ATTITUDE}, unit = 'rad' }}",
        [FIX, HEADING],
        "its heading turns by",
    ),
    "another hemisphere": ({"lat": -LATITUDE}, f"{TIME}\n{ATTITUDE} }}", [FIX, ODOMETRY], "turn"),
    "two recordings": (
        {"t": np.tile(STAMPS_S[:200], 2)},
        "time = { column = 't', order = 'any' }",
        [FIX],
        "alternate|faster than",
    ),
    "day and month": (
        {"t": DAYS},
        "time = { column = 't', unit = 'date', format = '%m/%d/%Y %H:%M:%S' }",
        [FIX],
        "day and month are swapped",
    ),
    "a unit of time": ({"t": STAMPS_S - 1_150_000_000}, TIME, [FIX], "begin on 1987"),
    "a rollover": (
        {"t": (np.rint(1e6 * (STAMPS_S - STAMPS_S[0])).astype(np.int64) + 2**32 - 10**8) % 2**32},
        "time = { column = 't', unit = 'us', order = 'any', zero = '2026-01-01' }",
        [FIX],
        "its clock was restarted .*`rollover` of `time`",
    ),
    "several vehicles": (
        {"t": np.tile(STAMPS_S[:200], 2), "lat": LATITUDE + 0.02 * (np.arange(400) >= 200)},
        "time = { column = 't', order = 'any' }",
        [FIX],
        "several vehicles",
    ),
    "newest first": (
        {name: COLUMNS[name][::-1] for name in ("lat", "lon", "speed", "turn")},
        "time = { rate_hz = 2, zero = '2026-01-01' }",
        [FIX, ODOMETRY],
        "turn_radps has the wrong sign",
    ),
    "longitudes to the west": (
        {"lon": -LONGITUDE},
        TIME,
        [FIX, ODOMETRY],
        "turn_radps has the wrong sign",
    ),
    "a code among headings": (
        {"heading": np.where(np.arange(400) % 20 == 3, 511, np.degrees(COURSE))},
        f"{TIME}\n{ATTITUDE} }}",
        [FIX, HEADING],
        "the heading in rad is .* in 20 messages, .*: a code for a missing value",
    ),
    "a code among speeds": (
        {"speed": np.where(np.arange(400) % 20 == 3, 52.6, SPEED)},
        TIME,
        [ODOMETRY],
        "forward_mps is 52.6 in 20 messages, .*: a code for a missing value",
    ),
    "a heading of 0": (
        {"heading": np.zeros(400)},
        f"{TIME}\n{ATTITUDE} }}",
        [FIX, HEADING],
        "its heading is the same in all messages, but the course of the fixes turns",
    ),
    "forces of 0": (
        INERTIAL | {"az": np.zeros(400)},
        TIME,
        [SAMPLES],
        "specific forces are exactly zero",
    ),
    "turn rates of 0": (
        INERTIAL | {"gz": np.zeros(400)},
        TIME,
        [SAMPLES],
        "turn rates are exactly zero",
    ),
    "samples of one stamp": (
        INERTIAL | {"t": np.repeat(STAMPS_S[:200], 2)},
        TIME,
        [SAMPLES],
        "estimators use the mean of both",
    ),
    "heights of two kinds": (
        {"alt": np.where(np.arange(400) % 50 < 25, 105, 152)},
        TIME,
        [FIX],
        "its altitude leaps 15 times, by up to 47 m",
    ),
    "a height of 0": (
        {"alt": np.where(np.arange(400) < 100, 0, 488)},
        TIME,
        [FIX],
        "its altitude leaps 1",
    ),
    "ns as us": (
        {"t": STAMPS_S * 1e3},
        "time = { column = 't', unit = 'us' }",
        [FIX],
        "1e.03 times too small",
    ),
    "whole seconds": (
        {"t": np.floor(STAMPS_S)},
        TIME,
        [ODOMETRY],
        "the first of the two .* has no effect",
    ),
}


@pytest.mark.paper
@pytest.mark.parametrize("name", WRONG)
def test_lint_names_what_a_wrong_mapping_does(name: str, tmp_path: Path) -> None:
    columns, table, streams, words = WRONG[name]
    assert re.search(words, _linted(tmp_path, columns, table, *streams))


def test_lint_finds_nothing_in_the_same_table_by_the_right_mapping(tmp_path: Path) -> None:
    table = f"{TIME}\nattitude = {{ heading = 'heading' }}"
    assert _linted(tmp_path, {}, table, FIX, ODOMETRY, HEADING) == ""
