"""The simulated targets that cross: their ways, and what the radar says of them."""

from collections.abc import Mapping

import numpy as np
import pytest

from fuselog.recorders.log import Stream
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import memory_source


def recorded(seed: int, **parameters: float) -> Mapping[str, Stream]:
    """The streams of a run, by topic."""
    return memory_source(*record_run("crossing", parameters, seed)).streams


def test_the_ways_of_the_targets():
    """1 and 2 meet in the middle at their angle, 3 and 4 stay side by side, 5 turns; one speed."""
    streams = recorded(3, duration_s=90.0)
    states = np.array([streams[f"/target{k}/truth"]["state"] for k in range(1, 6)])
    place, velocity = states[:, :, 0::2], states[:, :, 1::2]
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=2), 8.0, rtol=1e-12)
    np.testing.assert_allclose(place[:2, 45], 0.0, atol=1e-9)
    assert velocity[0, 0] @ velocity[1, 0] == pytest.approx(64 * np.cos(0.4), rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(place[2] - place[3], axis=1), 25.0, rtol=1e-12)
    moved = np.linalg.norm(np.diff(place, axis=1), axis=2)
    assert moved.max() == pytest.approx(8.0, rel=1e-12)
    assert moved[4].min() == pytest.approx(8.0, abs=0.2)
    heading = np.unwrap(np.arctan2(velocity[4, :, 1], velocity[4, :, 0]))
    assert np.ptp(heading) == pytest.approx(np.pi / 2, abs=1e-9)
    again = recorded(3, duration_s=90.0, clutter_per_scan=0.0)
    np.testing.assert_array_equal(again["/target1/truth"]["state"], states[0])


def test_what_the_radar_detects():
    """Detections of targets fail and are out as stated; the others are spread over the square."""
    streams = recorded(4, duration_s=400.0, detection_probability=0.7, clutter_per_scan=30.0)
    scan, seen = streams["/radar/scan"], streams["/radar/detection"]
    assert scan["detections"].sum() == len(seen)
    assert scan.metadata == {
        "sigma_m": "10.0",
        "detection_probability": "0.7",
        "clutter_per_m2": repr(30.0 / 1200.0**2),
    }
    false = scan["detections"].mean() - 5 * 0.7
    assert false == pytest.approx(30.0, abs=4 * np.sqrt(30.0 / 401))
    first = streams["/target3/truth"]["state"][:, 0::2]
    rows = np.searchsorted(scan["scan_id"], seen["scan_id"])
    error = seen["position_m"] - first[rows]
    own = np.abs(error).max(axis=1) < 10.0
    expected = 401 * 0.7 * 0.6827**2
    assert own.sum() == pytest.approx(expected, abs=4 * np.sqrt(expected))
