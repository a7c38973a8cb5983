"""BROAD files: what is read, what is dropped and told, and what is refused."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.broad import BROAD, BroadParameters

ROWS = 400
SENSORS = {
    "imu_acc": "specific_force_mps2",
    "imu_gyr": "turn_rate_radps",
    "imu_mag": "magnetic_field_ut",
}


def write(path: Path, **changes: np.ndarray | None) -> Path:
    """A small trial; a dataset that is None is left out."""
    data: dict[str, np.ndarray | None] = {
        "imu_gyr": np.zeros((ROWS, 3)),
        "imu_acc": np.tile([0.0, 0.0, 9.81], (ROWS, 1)),
        "imu_mag": np.tile([0.0, 20.0, -40.0], (ROWS, 1)),
        "opt_quat": np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1)),
        "movement": np.arange(ROWS) >= 300,
        **changes,
    }
    with h5py.File(path, "w") as file:
        file.attrs["sampling_rate"] = 100.0
        for name, values in data.items():
            if values is not None:
                file[name] = values
    return path


def read(path: Path):
    recording = BROAD.read(path, BroadParameters())
    return {stream.topic: stream for stream in recording.streams}, recording


def test_a_folder_is_one_run_with_topics_for_every_trial(tmp_path):
    write(tmp_path / "a.hdf5")
    write(tmp_path / "b.hdf5")
    streams, recording = read(tmp_path)
    assert set(streams) == {f"/{t}/{s}" for t in "ab" for s in ("truth", "inertial", "movement")}
    inertial = streams["/b/inertial"]
    np.testing.assert_array_equal(np.diff(inertial.publish_time_ns), 10_000_000)
    np.testing.assert_array_equal(inertial["specific_force_mps2"][0], [0.0, 0.0, 9.81])
    np.testing.assert_array_equal(streams["/a/movement"]["value"].ravel(), [0.0, 1.0])
    assert streams["/a/movement"].publish_time_ns[1] - recording.epoch_ns == 3_000_000_000
    assert not recording.notes


def test_every_sensor_goes_to_its_own_field(tmp_path):
    """Nine numbers of which no two are alike."""
    sensors = {
        name: np.random.default_rng(row).normal(size=(ROWS, 3)) for row, name in enumerate(SENSORS)
    }
    inertial = read(write(tmp_path / "a.hdf5", **sensors))[0]["/a/inertial"]
    for name, field in SENSORS.items():
        np.testing.assert_array_equal(inertial[field], sensors[name])


def test_what_is_not_finite_is_dropped_and_its_gaps_are_told(tmp_path):
    gyro, truth = np.zeros((ROWS, 3)), np.tile([1.0, 0, 0, 0], (ROWS, 1))
    gyro[100:150, 1] = np.nan
    truth[-5:] = np.nan
    streams, recording = read(write(tmp_path / "a.hdf5", imu_gyr=gyro, opt_quat=truth))
    assert len(streams["/a/inertial"]) == ROWS - 50
    assert len(streams["/a/truth"]) == ROWS - 5
    told = recording.notes["a, inertial samples"]
    assert told == "50 of 400 not finite, dropped, 1 gaps over 0.1 s, the longest 0.51 s"
    assert recording.notes["a, truth"] == "5 of 400 not finite, dropped"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"opt_quat": None}, "no truth, dataset opt_quat"),
        ({"opt_quat": np.full((ROWS, 4), np.nan)}, "every value of truth is NaN"),
        ({"opt_quat": np.full((ROWS, 4), 0.6)}, r"truth opt_quat: the vector at \(0,\) has length 1.2"),
        ({"opt_quat": np.zeros((ROWS, 4))}, "length 0"),
        ({"imu_gyr": np.full((ROWS, 3), np.nan)}, "every value of inertial samples is NaN"),
        ({"imu_mag": np.zeros((ROWS, 2))}, r"imu_mag has shape \(400, 2\); expected \(400, 3\)"),
        ({"imu_acc": None}, "dataset imu_acc"),
        ({"movement": np.zeros(0, bool)}, "movement is empty"),
        ({"opt_quat": np.full((ROWS, 4), b"x")}, "opt_quat is of .*; expected real numbers"),
        ({"imu_gyr": np.ones((ROWS, 3), complex)}, "imu_gyr is of complex128"),
    ],
)
def test_what_cannot_be_judged_is_refused(tmp_path, changes, message):
    with pytest.raises(BadInput, match=message):
        read(write(tmp_path / "a.hdf5", **changes))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"no \.hdf5 files"):
        read(tmp_path)
    (tmp_path / "a.hdf5").write_text("no HDF5")
    with pytest.raises(BadInput, match="cannot be read as HDF5"):
        read(tmp_path)
    write(tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file.attrs["sampling_rate"] = -1.0
    with pytest.raises(BadInput, match="sampling_rate"):
        read(tmp_path)
