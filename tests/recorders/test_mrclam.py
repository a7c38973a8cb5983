"""The MRCLAM importer: counts, clocks, barcodes, malformed files, and that filters work on it."""

import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.recording import Recording, import_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.judging.errors.evaluation import errors_of
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.metrics.metrics import ACCURACY, CONSISTENCY

# A set of one robot: two barcodes known, one not; times out of order; comments as in the real files.
SMALL = {
    "Barcodes.dat": "# Subject #    Barcode #\n  1 \t 5\n  6 \t 72\n  7 \t 27\n",
    "Landmark_Groundtruth.dat": "# Subject\n 6 \t 1.5 \t -4.25 0.1 0.1\n 7 \t 0.5 \t -4.5 0.1 0.1\n",
    "Robot1_Groundtruth.dat": "# Time\n1248444175.103 1 2 0.5\n1248444175.115 1 2 0.6\n",
    "Robot1_Odometry.dat": "# Time\n1248444175.106 \t 0.1 \t -0.4\n1248444175.200 0.2 0.0\n",
    "Robot1_Measurement.dat": "# Time\n1248444175.300 72 3.5 -0.25\n1248444175.300 99 1 1\n"
    "1248444175.150 27 2.5 0.75\n1248444175.300 5 9.5 0.1\n",
}


@pytest.fixture
def small(tmp_path: Path) -> Path:
    for name, text in SMALL.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def imported(folder: Path) -> tuple[Recording, dict[str, Stream]]:
    recording, _ = import_run("mrclam", folder, {})
    return recording, {stream.topic: stream for stream in recording.streams}


def test_a_small_set_number_by_number(small: Path):
    """Stamps exact to the printed millisecond, barcodes resolved, sorted by time, the rest noted."""
    recording, streams = imported(small)
    seen = streams["/robot1/range_bearing"]
    second = 1_000_000_000
    assert_array_equal(seen.publish_time_ns, 1248444175 * second + np.array([150, 300, 300]) * 1_000_000)
    assert seen["target_id"].tolist() == [7, 6, 1]
    assert seen["range_m"].tolist() == [2.5, 3.5, 9.5]
    assert seen["bearing_rad"].tolist() == [0.75, -0.25, 0.1]
    assert recording.notes == {"robot 1, unknown barcode 99": "1 measurements dropped"}
    assert recording.epoch_ns == 1248444175 * second + 103_000_000
    assert streams["/landmarks"]["landmark_id"].tolist() == [6, 7]
    assert streams["/landmarks"]["position_m"].tolist() == [[1.5, -4.25], [0.5, -4.5]]
    assert streams["/robot1/odometry"]["turn_radps"].tolist() == [-0.4, 0.0]
    prior = streams["/robot1/prior"]
    assert prior["mean"].tolist() == [[1, 2, 0.6]]  # the first truth after the first odometry
    assert prior.publish_time_ns[0] == 1248444175 * second + 115_000_000


def test_equal_stamps_stay_in_the_order_of_the_file(small: Path):
    """A look at many landmarks has one stamp; short arrays are sorted stably by accident."""
    rows = [(1248444176 + place * 7 % 3, place / 8) for place in range(120)]
    text = "".join(f"{time}.000 72 {range_m} 0\n" for time, range_m in rows)
    (small / "Robot1_Measurement.dat").write_text(text)
    seen = imported(small)[1]["/robot1/range_bearing"]
    assert seen["range_m"].tolist() == [range_m for _, range_m in sorted(rows, key=lambda row: row[0])]


@pytest.mark.parametrize("name", sorted(SMALL))
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (None, "missing"),
        ("", "no data rows"),
        ("# only a comment\n", "no data rows"),
        ("1 2 3 4 5 6 7\n", "has 7 columns, expected ."),
        ("1 2 3\n1 2 3 4 5 6\n", "cannot be read as columns"),
        (b"\xff\xfe\x00", "cannot be read as columns"),
        ("words", "is word, expected a number"),
        ("nan", "is nan, expected a number"),
        ("short", "is nan, expected a number"),
    ],
)
def test_missing_and_malformed_files_are_told_by_name(
    small: Path, name: str, damage: str | bytes | None, words: str
):
    path = small / name
    last = SMALL[name].splitlines()[-1].split()
    if damage is None:
        path.unlink()
    elif isinstance(damage, bytes):
        path.write_bytes(damage)
    elif damage in ("words", "nan"):
        path.write_text(SMALL[name] + " ".join(["word" if damage == "words" else "nan", *last[1:]]))
    elif damage == "short":
        path.write_text(SMALL[name] + " ".join(last[:-1]))
    else:
        path.write_text(damage)
    with pytest.raises(BadInput, match=words) as caught:
        imported(small)
    assert str(path) in str(caught.value)


def test_folders_that_are_no_set_are_told(small: Path, tmp_path: Path):
    with pytest.raises(BadInput, match=r"not a folder; give the folder that contains Barcodes\.dat"):
        imported(small / "Barcodes.dat")
    with pytest.raises(BadInput, match="no such file or folder"):
        imported(tmp_path / "nowhere")
    for path in small.glob("Robot1_*"):
        path.unlink()
    with pytest.raises(BadInput, match=r"has no files RobotN_\*\.dat"):
        imported(small)
    (small / "Robot1_Odometry.dat").mkdir()
    with pytest.raises(BadInput, match=r"Robot1_Groundtruth\.dat: no such file"):
        imported(small)


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("Robot1_Odometry.dat", "-5.0 0.1 0.1", "row 3, column 1 is -5.0, expected a time in seconds"),
        ("Robot1_Odometry.dat", "1e300 0.1 0.1", "row 3, column 1 is 1e300, expected a time"),
        ("Landmark_Groundtruth.dat", "8.5 1 2 0 0", "row 3, column 1 is 8.5, expected a whole number"),
        ("Barcodes.dat", "-3 17", "row 4, column 1 is -3"),
        ("Robot1_Measurement.dat", "1248444175.4 1.5 1 1", "row 5, column 2 is 1.5"),
    ],
)
def test_numbers_that_cannot_be_are_told(small: Path, name: str, row: str, words: str):
    with (small / name).open("a") as file:
        file.write(row)
    with pytest.raises(BadInput, match=words) as caught:
        imported(small)
    assert name in str(caught.value)


def test_a_set_begins_with_the_first_truth_of_any_robot(small: Path):
    """So that no robot has messages from before the landmarks are known."""
    for name in ("Groundtruth", "Odometry", "Measurement"):
        text = SMALL[f"Robot1_{name}.dat"]
        (small / f"Robot2_{name}.dat").write_text(text.replace("1248444175", "1248444174"))
    recording, streams = imported(small)
    assert recording.epoch_ns == 1248444174_103_000_000 == streams["/landmarks"].publish_time_ns[0]


# Real data: set 6.


@pytest.fixture(scope="module")
def set_6(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> MemorySource:
    folder = tmp_path_factory.mktemp("mrclam")
    with tarfile.open(real_data / "mrclam6.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    source = memory_source(*import_run("mrclam", folder / "mrclam6", {}))
    shutil.rmtree(folder)
    return source


@pytest.mark.paper
def test_set_6_has_every_message_but_the_unknown_barcodes(set_6: MemorySource):
    """Counts are the files' rows (less four lines of comments); 43, 34 and 50 are in no table."""
    counts = {topic: len(stream) for topic, stream in set_6.streams.items()}
    robots = range(1, 6)
    assert [counts[f"/robot{r}/truth"] for r in robots] == [49241, 59705, 56977, 61714, 57467]
    assert [counts[f"/robot{r}/odometry"] for r in robots] == [61785, 65005, 61158, 52916, 60567]
    assert [counts[f"/robot{r}/range_bearing"] for r in robots] == [1941, 4031, 5625, 2396, 5378]
    assert counts["/landmarks"] == 15
    assert set_6.run is not None
    assert set_6.run.notes == {
        "robot 1, unknown barcode 43": "1 measurements dropped",
        "robot 3, unknown barcode 34": "2 measurements dropped",
        "robot 4, unknown barcode 50": "3 measurements dropped",
    }


@pytest.mark.paper
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_filters_localize_the_robots_of_set_6(name: str, set_6: MemorySource):
    """From the truth's start: RMSE at most .22 m (robot 4: .30), NEES of the position at most 3.

    Measured, robots 1-5: EKF .169 .199 .170 .258 .167 m, NEES .95 1.28 1.56 .86 2.34; UKF .160 .191
    .165 .249 .166 m, NEES .89 1.25 1.52 .81 2.33.
    """
    outputs = collect(replay([set_6], bind(name, [set_6], {})))
    for robot in range(1, 6):
        errors = errors_of(
            outputs[f"/estimates/{name}/robot{robot}/pose"], [Truths(set_6)], gap_limit_s=0.2
        )
        assert errors is not None
        assert ACCURACY.of(errors)["position_rmse_m"] <= (0.30 if robot == 4 else 0.22)
        assert 0.5 <= CONSISTENCY.of(errors)["position_nees"] <= 3
        truth = set_6.streams[f"/robot{robot}/truth"].publish_time_ns
        assert len(errors.nees) > 50000  # judged all along, but not where the truth is silent
        after_its_end = (
            outputs[f"/estimates/{name}/robot{robot}/pose"].stream.publish_time_ns > truth[-1]
        )
        assert errors.without_truth >= after_its_end.sum()


@pytest.mark.paper
def test_dead_reckoning_drifts_where_the_landmarks_hold(set_6: MemorySource):
    """The RMSE above is the landmarks' doing: without them it is metres."""
    outputs = collect(replay([set_6], bind("dead-reckoning", [set_6], {})))
    errors = errors_of(
        outputs["/estimates/dead-reckoning/robot1/pose"], [Truths(set_6)], gap_limit_s=0.2
    )
    assert errors is not None
    assert ACCURACY.of(errors)["position_rmse_m"] > 1
    assert_allclose(np.linalg.norm(errors.error[0, :2]), 0, atol=0.01)
