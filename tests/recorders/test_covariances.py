"""Covariances come in whole: every entry is where it was, in our axes and units.

Those that are given have no two equal entries, but for the symmetry, so that each one that is lost,
moved or turned the wrong way shows. What they become is computed by matrices, or by small rotations.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fuselog.recorders.importers.ulog.importer import ULOG, UlogParameters
from fuselog.recorders.log import Stream
from fuselog.recorders.models.orientation import rotate
from fuselog.recorders.recording import import_run
from tests.recorders.test_ros import START_NS, Maker, Sent, imported, write_bag
from tests.recorders.test_ulog import by_hand, message


def unlike(size: int, seed: int = 0) -> np.ndarray:
    """A covariance (size, size) without equal entries."""
    root = np.random.default_rng(seed).normal(size=(size, size)) + 2.0 * np.eye(size)
    return root @ root.T


def found_in(streams: dict[str, Stream]) -> dict[str, np.ndarray]:
    """All covariances of messages and channels that are known, by topic and name."""
    found = {}
    for topic, stream in streams.items():
        for name, column in stream.columns.items():
            if "covariance" in name and np.isfinite(column).all():
                found[f"{topic} {name}"] = column[0]
        for name, text in stream.metadata.items():
            if "covariance" in name and "nan" not in text:
                found[f"{topic} {name}"] = np.array(text.split(","), float)
    return found


def test_those_of_bags_are_where_they_were(tmp_path: Path) -> None:
    """Of every type that has one, and no others; Tesla squared become microtesla squared."""
    make, sent, wanted = Maker(), [], {}
    for number, (kind, given) in enumerate(
        {
            "sensor_msgs/msg/NavSatFix": {"position_covariance": "fix covariance_m2"},
            "sensor_msgs/msg/Imu": {
                "linear_acceleration_covariance": "inertial specific_force_covariance_m2ps4",
                "angular_velocity_covariance": "inertial turn_rate_covariance_rad2ps2",
                "orientation_covariance": "orientation covariance_rad2",
            },
            "sensor_msgs/msg/MagneticField": {
                "magnetic_field_covariance": "magnetic_field covariance_ut2"
            },
            "nav_msgs/msg/Odometry": {
                "pose__covariance": "odometry_pose covariance",
                "twist__covariance": "odometry_twist covariance",
            },
            "geometry_msgs/msg/TwistWithCovariance": {"covariance": "twist covariance"},
            "geometry_msgs/msg/TwistWithCovarianceStamped": {"twist__covariance": "twist covariance"},
            "geometry_msgs/msg/PoseWithCovariance": {"covariance": "pose covariance"},
            "geometry_msgs/msg/PoseWithCovarianceStamped": {"pose__covariance": "pose covariance"},
            "geometry_msgs/msg/PoseStamped": {},
        }.items()
    ):
        values: dict[str, Any] = {"position_covariance_type": 3}
        for column, (field, becomes) in enumerate(given.items()):
            size = 3 if "_covariance" in field and "__" not in field else 6
            scale = 1e-12 if "magnetic" in field else 1.0
            matrix = unlike(size, 10 * number + column)
            values[field] = scale * matrix.ravel()
            wanted[f"/in{number}/{becomes}"] = matrix.ravel()
        sent.append((f"/in{number}/topic", START_NS, make(kind, START_NS, **values)))
    messages: list[Sent] = sent
    streams, _ = imported(write_bag(tmp_path / "bag", "mcap", messages, make.store), clock="bag")
    found = found_in(streams)
    assert set(found) == set(wanted)
    for name, matrix in wanted.items():
        assert_allclose(found[name], matrix, rtol=1e-8, err_msg=name)


MOUNTED = """
[[tables]]
time = { column = "t" }
[[tables.streams]]
topic = "/field"
becomes = "MagneticField"
fields = { magnetic_field_ut = ["a", "b", "c"] }
deviations = { covariance_ut2 = ["a", "b", "c"] }
cross_deviations = { covariance_ut2 = ["ab", "ac", "bc"] }
units = { covariance_ut2 = "mT" }
inflated = [{ where = { ab = -1.0 }, by = 3 }]
mounting_deg = [10, 20, 30]
[[tables.streams]]
topic = "/fix"
becomes = "PositionFix"
fields = { position_m = ["a", "b", "c"] }
deviations = { covariance_m2 = ["a", "b", "c"] }
cross_deviations = { covariance_m2 = ["ab", "ac", "bc"] }
factors = { covariance_m2 = [1, 2, 3] }
[[tables.streams]]
topic = "/twist"
becomes = "Twist"
fields = { velocity_mps = ["a", "b", "c"], turn_rate_radps = ["ab", "ac", "bc"] }
deviations = { covariance = [1, 2, 3, 4, 5, 6] }
mounting_deg = [10, 20, 30]
"""


def test_those_of_tables_have_units_factors_and_a_mounting(tmp_path: Path) -> None:
    """By roots with their signs; a mounting turns both blocks of a twist."""
    (tmp_path / "table.csv").write_text("t,a,b,c,ab,ac,bc\n1,3,4,5,-1,1.5,2\n2,6,5,4,2,-1.5,1\n")
    (tmp_path / "mapping.toml").write_text(MOUNTED)
    settings = {"mapping": str(tmp_path / "mapping.toml")}
    recording, _ = import_run("table", tmp_path / "table.csv", settings)
    streams = {each.topic: each for each in recording.streams}
    given = np.array(
        [
            [[9, -1, 2.25], [-1, 16, 4], [2.25, 4, 25]],
            [[36, 4, -2.25], [4, 25, 1], [-2.25, 1, 16]],
        ]
    )
    turn = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True).as_matrix()
    inflated = given * np.array([9.0, 1.0])[:, None, None] * 1e6
    found = streams["/field"]["covariance_ut2"].reshape(-1, 3, 3)
    assert_allclose(found, turn @ inflated @ turn.T, rtol=1e-12)
    assert_allclose(streams["/field"]["magnetic_field_ut"], np.array([[3, 4, 5], [6, 5, 4]]) @ turn.T)
    factors = np.diag([1.0, 2.0, 3.0])
    assert_allclose(streams["/fix"]["covariance_m2"].reshape(-1, 3, 3), factors @ given @ factors)
    twist = np.zeros((6, 6))
    twist[:3, :3], twist[3:, 3:] = (
        turn @ np.diag([1, 4, 9]) @ turn.T,
        turn @ np.diag([16, 25, 36]) @ turn.T,
    )
    for row in streams["/twist"]["covariance"]:
        assert_allclose(row.reshape(6, 6), twist, atol=1e-12)


@pytest.mark.parametrize("count", [24, 23])
def test_that_of_a_ulogs_orientation_is_about_the_bodys_axes(tmp_path: Path, count: int) -> None:
    """A turned vehicle: of a quaternion's four numbers, or of rotations about north, east and down.

    By small changes of each, one after the other: the rotation that it makes about the body's axes.
    """
    logged = Rotation.from_euler("ZYX", [40.0, -25.0, 65.0], degrees=True)
    states = np.concatenate([logged.as_quat(scalar_first=True), np.arange(1.0, 21.0)])
    turns = np.array([0.005, 0.01, 0.02, 0.03] if count == 24 else [0.02, 0.03, 0.05])
    step = 1e-6
    if count == 24:
        changed = [states[:4] + step * each for each in np.eye(4)]
        moved = [Rotation.from_quat(each, scalar_first=True) for each in changed]
    else:
        moved = [Rotation.from_rotvec(step * each) * logged for each in np.eye(3)]
    ways = np.array([(logged.inv() * each).as_rotvec() for each in moved]) / step
    ways = ways * [1.0, -1.0, -1.0]  # of forward, right, down to forward, left, up
    fields = f"float[24] states;float[{count}] covariances;"
    layout = f"estimator_states:uint64_t timestamp;uint64_t timestamp_sample;{fields}uint8_t n_states;"
    variances = np.concatenate([turns, [0.1, 0.2, 0.3], [1, 2, 3], np.zeros(count - 6 - len(turns))])
    body = np.concatenate([states, variances]).astype("<f4").tobytes() + b"\x18"
    rows = message("D", struct.pack("<HQQ", 20, 1_000_000, 1_000_000) + body)
    subscribed = message("A", struct.pack("<BH", 0, 20) + b"estimator_states")
    path = tmp_path / "states.ulg"
    path.write_bytes(by_hand(subscribed, formats=(layout,), last=rows))
    streams = {each.topic: each for each in ULOG.read(path, UlogParameters()).together().streams}
    stream = streams["/estimates/ekf2/vehicle/state"]
    expected = np.diag([2.0, 1.0, 3.0, 0.2, 0.1, 0.3, 0.0, 0.0, 0.0])
    expected[6:, 6:] = np.einsum("k,ki,kj->ij", turns, ways, ways)
    assert_allclose(stream["covariance"].reshape(9, 9), expected, atol=1e-6)
    forward = logged.apply([1.0, 0.0, 0.0])[[1, 0, 2]] * [1.0, 1.0, -1.0]
    assert_allclose(rotate(stream["mean"][0, 6:], np.array([1.0, 0.0, 0.0])), forward, atol=1e-6)
