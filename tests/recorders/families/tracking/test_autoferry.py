"""Autoferry scenarios: shapes of measurements, two clocks, the axes of the log, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import import_run

START_S = 1_620_000_000.25


def scan(sensor: int, time_s: float, measurement: Any, ownship=(100.0, 10.0)) -> dict[str, Any]:
    """An entry as published, `time_s` after the start."""
    return {
        "sensorID": sensor,
        "time": START_S + time_s,
        "ownshipPosition": list(ownship),
        "measurements": [],
        "measurement": measurement,
    }


def target(number: int, time_s: float, north: float, east: float) -> dict[str, Any]:
    return {"targetID": number, "time": START_S + time_s, "position": [north, east, 0]}


SCANS = [
    scan(1, 0.0, [[1.0, 2.0], [3.0, 4.0]]),
    scan(2, 1.0, [5.0, 6.0], ownship=(101.0, 11.0)),
    scan(4, 0.75, 0.5),
    scan(1, 1.5, []),
    scan(3, 1.25, [np.pi, -3.0, 0.0]),
]
TRUTH = [
    [target(1, 0.0, 7.0, 8.0), target(2, -0.5, 1.0, 2.0)],
    [target(1, 0.0, 7.0, 8.0), target(2, 0.5, 3.0, 4.0)],
]


def write(folder: Path, scans: Any = SCANS, truth: Any = TRUTH) -> Path:
    (folder / "scenario1_detections.json").write_text(json.dumps(scans))
    (folder / "scenario1_groundTruth.json").write_text(json.dumps(truth))
    return folder


def test_shapes_axes_and_clocks(tmp_path: Path):
    """Rows of a 2 x 2 measurement are north and east; bearings turn from clockwise from north."""
    recording, _ = import_run("autoferry", write(tmp_path), {"radar": {"lag_s": 0.5}})
    streams = {stream.topic: stream for stream in recording.streams}
    lidar, radar = streams["/lidar/detection"], streams["/radar/detection"]
    assert lidar["position_m"].tolist() == [[3.0, 1.0], [4.0, 2.0]]
    assert radar["position_m"].tolist() == [[6.0, 5.0]]
    assert streams["/lidar/scan"]["detections"].tolist() == [2, 0]
    assert streams["/electro_optical/bearing"]["bearing_rad"] == pytest.approx([np.pi / 2 - 0.5])
    infrared = streams["/infrared/bearing"]["bearing_rad"]
    assert infrared == pytest.approx([-np.pi / 2, 3.0 + np.pi / 2 - 2 * np.pi, np.pi / 2])
    fix = streams["/ownship/fix"]
    assert fix["position_m"][:2].tolist() == [[10.0, 100.0], [11.0, 101.0]]
    late = streams["/electro_optical/scan"]
    start_ns = int(START_S * 4) * 10**9 // 4
    assert recording.epoch_ns == start_ns
    assert late.publish_time_ns.tolist() == [start_ns + 750_000_000]
    assert late.log_time_ns.tolist() == [start_ns + 10**9]
    assert recording.notes["electro_optical scans"] == "1, 0 of them empty, 1 late by up to 0.250 s"
    assert recording.notes["lidar scans"] == "2, 1 of them empty"
    first, second = streams["/target1/truth"], streams["/target2/truth"]
    assert first["state"].tolist() == [[8.0, 7.0]]
    assert second.publish_time_ns.tolist() == [start_ns - 500_000_000, start_ns + 500_000_000]
    assert streams["/radar/scan"].metadata["lag_s"] == "0.5"
    assert streams["/radar/scan"].metadata["sigma_m"] == "5.0"


def test_the_published_scenarios(autoferry: Path):
    """Late scans as the sheet counts them, and no scan lost."""
    recording, _ = import_run("autoferry", autoferry / "scenario16", {})
    notes = recording.notes
    assert notes["lidar scans"] == "235, 98 of them empty"
    assert notes["radar scans"] == "72, 0 of them empty, 10 late by up to 0.711 s"
    assert notes["infrared scans"].endswith("89 late by up to 0.043 s")
    assert notes["electro_optical scans"].startswith("593, 0 of them empty, 591 late by up to 0.17")


@pytest.mark.parametrize(
    ("scans", "truth", "said"),
    [
        ([scan(5, 0, [])], TRUTH, "scan 0: sensorID is 5"),
        ([scan([1], 0, [])], TRUTH, r"scan 0: sensorID is \[1\]"),
        ([SCANS[0], {"sensorID": 1}], TRUTH, "scan 1: has no time"),
        ([scan(1, 0, [1.0, 2.0, 3.0])], TRUTH, r"\[N, E\]"),
        ([scan(1, 0, [[1.0, 2.0], [3.0]])], TRUTH, "measurement is not 2 numbers"),
        ([scan(1, 0, [1.0, [2.0]])], TRUTH, r"\[N, E\]"),
        ([scan(3, 0, [[1.0], [2.0]])], TRUTH, "measurement is not"),
        ([scan(2, 0, [], ownship=(1.0,))], TRUTH, "ownshipPosition is not 2 numbers"),
        ([scan(2, -START_S - 1, [])], TRUTH, "seconds since 1970"),
        ([], TRUTH, "not a list of entries"),
        (SCANS, [[target(1, 0, 1, 1)], [target(1, 0, 1, 2)]], "two positions at one time"),
        (SCANS, [[{"targetID": 1.5, "time": 0, "position": [0, 0, 0]}]], "targetID is 1.5"),
    ],
)
def test_what_is_not_as_published_is_named(tmp_path: Path, scans, truth, said: str):
    with pytest.raises(BadInput, match=said):
        import_run("autoferry", write(tmp_path, scans, truth), {})


def test_other_places_are_refused(tmp_path: Path):
    with pytest.raises(BadInput, match=r"no files .* expected one; give the folder of one"):
        import_run("autoferry", tmp_path, {})
    write(tmp_path)
    with pytest.raises(BadInput, match="give the folder of one"):
        import_run("autoferry", tmp_path / "scenario1_detections.json", {})
    (tmp_path / "scenario1_detections.json").write_text("[{]")
    with pytest.raises(BadInput, match="cannot be read as JSON"):
        import_run("autoferry", tmp_path, {})
