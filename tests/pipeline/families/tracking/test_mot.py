"""Tracks and truths frame by frame: read back by the columns that TrackEval reads."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.states import state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.families.tracking.judging.distances import hota
from tests.replay.families.tracking.test_tracker import RADAR, SECOND, log, passing, sensor

Fuselog = Callable[..., Any]


@pytest.fixture(autouse=True)
def _scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uncompiled: None) -> None:
    """Two vessels; one has a truth from 2 s on. What the radar says of it is 3 m too far north."""
    monkeypatch.chdir(tmp_path)
    seen = [[(x, 103.0), (-400.0, x)] for [(x, _)] in passing(12)]
    seconds = np.arange(2, 12)
    truth = make_stream(
        "/vessel/truth",
        schemas.TRUTH_STATE,
        SIMULATION_EPOCH_NS + seconds * SECOND,
        metadata=state_metadata(("x_m", "y_m")),
        state=np.stack([2.0 * seconds, np.full(10, 100.0)], axis=1),
    )
    source = log([truth], sensor("radar", RADAR, range(12), seen))
    fl.write("run.mcap", source)


def test_tracks_and_truths_frame_by_frame(fuselog: Fuselog) -> None:
    """A frame every .5 s; HOTA of the files is that of the two followed from when they are confirmed."""
    said = fuselog("replay", "run.mcap", "-e", "tracker:hungarian", "-o", "est.mcap")
    assert said.code == 0, said.err
    for name in ("run", "est"):
        assert fuselog("export", f"{name}.mcap", "--to", "mot").code == 0
    truth, found = (
        np.loadtxt(path, delimiter=",") for path in ("run-mot/gt.txt", "est-mot/tracker%3Ahungarian.txt")
    )
    assert truth[:, 0].tolist() == list(range(5, 24))
    np.testing.assert_array_equal(truth[:, 1:4], [[1, frame - 1, 100] for frame in range(5, 24)])
    np.testing.assert_array_equal(truth[:, 4:], np.tile([0, 0, 1, 1, 1], (19, 1)))
    np.testing.assert_array_equal(found[:, 4:], np.tile([0, 0, 1, -1, -1, -1], (len(found), 1)))
    assert sorted(set(found[:, 1])) == [1, 2]
    assert found[:, 0].min() == 7
    tracks = fl.open("est.mcap")["/estimates/tracker:hungarian/track"]
    last = tracks.take(tracks.publish_time_ns == tracks.publish_time_ns[-1])
    np.testing.assert_allclose(found[-2:, 2:4], last["mean"][:, [0, 2]], rtol=1e-15)
    middle = found[(found[:, 0] == 8) & (found[:, 1] == 1), 2:4]
    fourth = tracks.take(tracks["track_id"] == 1)["mean"][0]
    np.testing.assert_allclose(middle, [fourth[[0, 2]] + 0.5 * fourth[[1, 3]]], rtol=1e-15)

    def trajectories(rows: Any) -> Any:
        points = np.full((int(rows[:, 1].max()), 23, 2), np.nan)
        points[rows[:, 1].astype(int) - 1, rows[:, 0].astype(int) - 1] = rows[:, 2:4]
        return points

    judged = hota(trajectories(found), trajectories(truth), 20.0)
    assert judged.hota[0] == pytest.approx(np.sqrt(17 / 36 * 17 / 19))


def test_what_is_no_track_is_refused(fuselog: Fuselog) -> None:
    for options, words in (
        (("--topic", "/radar/scan"), "has neither tracks nor a truth in the plane"),
        (("--topic", "/radar/scn"), "did you mean '/radar/scan'"),
    ):
        said = fuselog("export", "run.mcap", "--to", "mot", *options)
        assert (said.code, words in said.err) == (2, True), said.err
    source = log(sensor("radar", RADAR, range(3), [[]] * 3))
    fl.write("none.mcap", source)
    said = fuselog("export", "none.mcap", "--to", "mot")
    assert (said.code, "neither tracks nor truths in the plane" in said.err) == (2, True)
    assert fuselog("export", "run.mcap", "--to", "mot").code == 0
    assert (
        "exists, and fuselog export does not replace files"
        in fuselog("export", "run.mcap", "--to", "mot").err
    )
