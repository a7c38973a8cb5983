"""Bags for ROS 2: what rosbags, the importer and evo read is what the estimates state."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from scipy.spatial.transform import Rotation

import fuselog as fl
from fuselog.recorders.models.geodesy import into_tangent_plane, tangent_axes
from fuselog.replay.engine.vectors.components import in_body_axes

Fuselog = Callable[..., Any]
ORIGIN = (48.137, 11.575, 520.0)
COUNT = 30
STAMPS_NS = 1_700_000_000_123_456_789 + np.arange(COUNT) * 49_999_999
LATE_NS = 1_000_003
TURN = [f"orientation_{axis}" for axis in "wxyz"]
MOVING = ["x_m", "vx_mps", "y_m", "vy_mps", "z_m", "vz_mps", *TURN, "gyro_bias_x_radps"]
INS, PLANE, POINTS = "/estimates/ins/pose", "/estimates/smoother:ekf/2/pose", "/estimates/no-one/pose"
OWN = {
    topic: topic.translate({ord(each): "_" for each in ":-"}).replace("/2", "/_2")
    for topic in (INS, PLANE, POINTS)
}
UNKNOWN = 1e6


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def stream(topic: str, schema: Any, components: Sequence[str], **columns: Any) -> fl.Stream:
    kinds = [
        "quaternion" if name in TURN else "angle" if name == "heading_rad" else "linear"
        for name in components
    ]
    metadata = {"components": ",".join(components), "kinds": ",".join(kinds)}
    if "mean" in columns:
        metadata["truth"] = "/truth"
    if topic == INS:
        names = ("origin_latitude_deg", "origin_longitude_deg", "origin_altitude_m")
        metadata |= dict(zip(names, map(repr, ORIGIN), strict=True)) | {"frame_id": "map"}
    logged_ns = STAMPS_NS + LATE_NS
    return fl.make_stream(topic, schema, STAMPS_NS, log_time_ns=logged_ns, metadata=metadata, **columns)


def spreads(rng: np.random.Generator, size: int) -> np.ndarray:
    factors = 0.1 * rng.normal(size=(COUNT, size, size))
    return np.asarray(factors @ factors.swapaxes(1, 2))


@pytest.fixture
def drive() -> dict[str, fl.Stream]:
    """A truth in space, and estimates of a moving body, of a robot in the plane, and of points."""
    rng = np.random.default_rng(8)
    turned, place_m = Rotation.random(COUNT, rng=rng), 1e3 * rng.normal(size=(COUNT, 3))
    near_m = place_m + 0.1 * rng.normal(size=(COUNT, 3))
    near = turned * Rotation.from_rotvec(0.02 * rng.normal(size=(COUNT, 3)))
    velocity, flat = rng.normal(size=(COUNT, 3)), rng.uniform(-3.1, 3.1, size=(COUNT, 1))
    both = np.stack([near_m, velocity], axis=2).reshape(COUNT, 6)
    mean = np.hstack([both, near.as_quat(scalar_first=True), rng.normal(size=(COUNT, 1))])
    truth = np.hstack([place_m, turned.as_quat(scalar_first=True)])
    states = {
        INS: (MOVING, mean, spreads(rng, 10)),
        PLANE: (["heading_rad", "x_m", "y_m"], np.hstack([flat, near_m[:, :2]]), spreads(rng, 3)),
        POINTS: (["x_m", "y_m", "z_m"], near_m, np.zeros((COUNT, 3, 3))),
    }
    made = [stream("/truth", fl.schemas.TRUTH_STATE, ["x_m", "y_m", "z_m", *TURN], state=truth)]
    for topic, (names, states_of, covariance) in states.items():
        columns = {"mean": states_of, "covariance": covariance.reshape(COUNT, -1)}
        made.append(stream(topic, fl.schemas.GAUSSIAN_ESTIMATE, names, **columns))
    fl.write("drive.mcap", made)
    return {each.topic: each for each in made}


def messages(bag: str) -> dict[str, list[tuple[int, Any]]]:
    """The messages of a bag as rosbags reads them, with their times there, by topic."""
    found = defaultdict(list)
    with AnyReader([Path(bag)]) as reader:
        for connection, time_ns, raw in reader.messages():
            found[connection.topic].append((time_ns, reader.deserialize(raw, connection.msgtype)))
    return found


def xyzw(of: Any) -> list[float]:
    return [of.x, of.y, of.z, of.w] if hasattr(of, "w") else [of.x, of.y, of.z]


@pytest.mark.parametrize("to", ["ros2", pytest.param("ros2-sqlite3", marks=pytest.mark.paper)])
def test_rosbags_reads_what_estimates_state(
    to: str, drive: dict[str, fl.Stream], fuselog: Fuselog
) -> None:
    said = fuselog("export", "drive.mcap", "--to", to, "-o", "bag")
    assert said.code == 0
    assert sorted(path.name for path in Path("bag").iterdir()) == [
        *(["bag.mcap"] if to == "ros2" else ["bag.db3"]),
        "metadata.yaml",
    ]
    assert f"{INS}: omitted, because ROS has no field for them: gyro_bias_x_radps" in said.err
    assert f"{POINTS}: has no orientation; the identity is written instead" in said.err
    found = messages("bag")
    fix, flat, points = (f"{OWN[topic]}/fix" for topic in OWN)  # one topic states the origin of all
    assert set(found) == {"/truth", *OWN.values(), "/tf", fix, flat, points}
    for _, each in found[flat]:
        assert np.isnan(each.altitude)
        assert_array_equal(each.position_covariance[6:], [0.0, 0.0, UNKNOWN])
    assert {each.position_covariance_type for _, each in found[points]} == {0}
    for topic, sent in found.items():
        assert [time_ns for time_ns, _ in sent] == sorted(
            np.tile(STAMPS_NS + LATE_NS, len(sent) // COUNT)
        )
        heads = [each.transforms[0].header if topic == "/tf" else each.header for _, each in sent]
        assert [each.stamp.sec * 10**9 + each.stamp.nanosec for each in heads] == sorted(
            np.tile(STAMPS_NS, len(sent) // COUNT)
        )
        assert {each.frame_id for each in heads} == {"map"}
    ins = drive[INS]
    stated = ins["covariance"].reshape(COUNT, 10, 10)
    for row, (_, odometry) in enumerate(found[OWN[INS]]):
        velocity, turned = (
            ins["mean"][row, 1:6:2],
            Rotation.from_quat(ins["mean"][row, 6:10], scalar_first=True),
        )
        assert_allclose(xyzw(odometry.twist.twist.linear), turned.inv().apply(velocity), atol=1e-12)

        def along(
            error: np.ndarray, velocity: np.ndarray = velocity, turned: Rotation = turned
        ) -> np.ndarray:
            """The velocity along the body's axes, with errors of velocity and of rotation in them."""
            return (turned * Rotation.from_rotvec(error[3:])).inv().apply(velocity + error[:3])

        step = 1e-6 * np.eye(6)
        jacobian = np.stack([(along(each) - along(-each)) / 2e-6 for each in step], axis=1)
        part = stated[row][np.ix_([1, 3, 5, 6, 7, 8], [1, 3, 5, 6, 7, 8])]
        spread = odometry.twist.covariance.reshape(6, 6)
        assert_allclose(spread[:3, :3], jacobian @ part @ jacobian.T, atol=1e-8)
        assert_array_equal(spread[3:, 3:], UNKNOWN * np.eye(3))
        place = into_tangent_plane(
            (*(getattr(found[fix][row][1], name) for name in ("latitude", "longitude", "altitude")),),
            ORIGIN,
        )
        assert_allclose(place, ins["mean"][row, 0:6:2], atol=1e-6)
        there = found[fix][row][1]
        axes = tangent_axes(there.latitude, there.longitude) @ tangent_axes(*ORIGIN[:2]).T
        covariance = there.position_covariance.reshape(3, 3)
        assert there.position_covariance_type == 3
        assert_allclose(covariance, axes @ stated[row][:6:2, :6:2] @ axes.T, atol=1e-12)
    assert not any(each.pose.covariance.any() for _, each in found[OWN[POINTS]])
    children = defaultdict(list)
    for _, each in found["/tf"]:
        children[each.transforms[0].child_frame_id].append(each.transforms[0].transform)
    assert set(children) == {f"{topic.strip('/')}/base_link" for topic in (INS, PLANE)}
    moved = children[f"{PLANE.strip('/')}/base_link"]
    heading_rad = Rotation.from_quat([xyzw(each.rotation) for each in moved]).as_euler("ZYX")
    assert_allclose(heading_rad[:, 0], drive[PLANE]["mean"][:, 0], atol=1e-12)
    assert {each.translation.z for each in moved} == {0.0}


@pytest.mark.paper
def test_the_importer_reads_the_same_estimates(drive: dict[str, fl.Stream], fuselog: Fuselog) -> None:
    """Means and covariances to 1e-12; a robot in the plane has no height, roll and pitch to err in."""
    assert fuselog("export", "drive.mcap", "--to", "ros2").code == 0
    wanted = ",".join(f'"{topic}"' for topic in OWN.values())
    chosen = ("--set", "truth=/truth", "--set", f"estimates=[{wanted}]")
    assert fuselog("import", "ros", "drive-ros2", "-o", "back.mcap", *chosen).code == 0
    back = fl.open("back.mcap")
    found = {topic: back[f"/estimates/{OWN[topic].strip('/').replace('/', '_')}/pose"] for topic in OWN}
    ins, rows = drive[INS], [0, 2, 4, 6, 7, 8]
    for topic, each in found.items():
        assert_array_equal(each.publish_time_ns, STAMPS_NS)
        assert_array_equal(each.log_time_ns, STAMPS_NS + LATE_NS)
        assert each.metadata["frame_id"] == "map", topic
    assert_allclose(found[INS]["mean"][:, :3], ins["mean"][:, 0:6:2], rtol=1e-12)
    turns = ins["mean"][:, 6:10], found[INS]["mean"][:, 3:]
    assert_allclose(np.abs(np.sum(turns[0] * turns[1], axis=1)), 1.0, rtol=1e-12)
    stated = ins["covariance"].reshape(COUNT, 10, 10)[:, rows][:, :, rows]
    assert_allclose(in_body_axes(found[INS])["covariance"].reshape(COUNT, 6, 6), stated, atol=1e-12)
    plane, flat = drive[PLANE], found[PLANE]["covariance"].reshape(COUNT, 6, 6)
    assert_allclose(found[PLANE]["mean"][:, :3] @ np.eye(3)[:, :2], plane["mean"][:, 1:], rtol=1e-12)
    expected = np.zeros((COUNT, 6, 6))
    expected[:, [[5], [0], [1]], [5, 0, 1]] = plane["covariance"].reshape(COUNT, 3, 3)
    assert_allclose(flat, expected, atol=1e-12)
    assert_array_equal(found[POINTS]["covariance"], 0.0)
    before = fuselog("evaluate", "drive.mcap", "--json").json["metrics"]
    after = fuselog("evaluate", "back.mcap", "--json").json["metrics"]
    for metric in ("position_rmse_m", "position_nees"):
        own = f"ins.{metric}"
        assert after[f"estimates_ins_pose.{metric}"] == pytest.approx(before[own], rel=1e-9), metric


def test_one_estimate_is_base_link(drive: dict[str, fl.Stream], fuselog: Fuselog) -> None:
    """A single estimate has the frame that REP 105 names; it is that of its odometry and of TF."""
    assert fuselog("export", "drive.mcap", "--to", "ros2", "-o", "bag", "--topic", INS).code == 0
    found = messages("bag")
    frames = {each.transforms[0].child_frame_id for _, each in found["/tf"]}
    assert frames == {each.child_frame_id for _, each in found[INS]} == {"base_link"}
    assert set(found) == {INS, f"{INS}/fix", "/tf"}


@pytest.mark.paper
def test_evo_finds_the_error_that_evaluate_finds(
    world: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(Path.cwd()))  # evo writes its settings there
    reason = "evo, which reads the bag here, is not installed: pip install evo"
    interface = pytest.importorskip("evo.tools.file_interface", reason=reason)
    from evo.core import metrics, sync

    assert (
        fuselog("merge", world / "log.mcap", world / "log.estimates.mcap", "-o", "both.mcap").code == 0
    )
    assert fuselog("export", "both.mcap", "--to", "ros2", "-o", "bag").code == 0
    with Reader(Path("bag")) as reader:
        read = [
            interface.read_bag_trajectory(reader, topic)
            for topic in ("/robot1/truth", "/estimates/ekf/robot1/pose")
        ]
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(sync.associate_trajectories(*read))
    ours = fuselog("evaluate", world / "log.estimates.mcap", "--json").json["metrics"]
    rmse_m = error.get_statistic(metrics.StatisticsType.rmse)
    assert rmse_m == pytest.approx(ours["ekf.position_rmse_m.robot1"], rel=1e-12)


def test_fixes_keep_what_they_state(fuselog: Fuselog) -> None:
    """Covariances of any form; a missing height has a large variance, an unknown one its own type."""
    stated = {
        "/a/fix": [[4.0, 1.0, 1.0, 9.0], [np.nan] * 4],
        "/b/fix": [[4.0, 9.0, 1.0], [1.0, 2.0, 3.0]],
    }
    fl.write(
        "log.mcap",
        [
            fl.make_stream(
                topic,
                fl.schemas.GEODETIC_FIX,
                STAMPS_NS[:2],
                latitude_deg=[48.0, 48.1],
                longitude_deg=[11.0, 11.2],
                altitude_m=[500.0, np.nan],
                covariance_m2=covariance,
            )
            for topic, covariance in stated.items()
        ],
    )
    assert fuselog("export", "log.mcap", "--to", "ros2", "-o", "bag").code == 0
    a, b = ([each for _, each in messages("bag")[topic]] for topic in stated)
    assert [each.position_covariance_type for each in (*a, *b)] == [3, 0, 3, 3]
    assert_array_equal(a[0].position_covariance, [4, 1, 0, 1, 9, 0, 0, 0, UNKNOWN])
    assert_array_equal(b[0].position_covariance, [4, 0, 0, 0, 9, 0, 0, 0, 1])
    assert_array_equal([a[1].latitude, a[1].longitude, a[1].altitude], [48.1, 11.2, np.nan])


def _bad_logs() -> Iterator[tuple[str, list[fl.Stream], tuple[str, ...]]]:
    def truth(topic: str, stamp_ns: int = 0, x_m: float = 1.0) -> fl.Stream:
        metadata = {"components": "x_m,y_m", "kinds": "linear,linear"}
        return fl.make_stream(
            topic, fl.schemas.TRUTH_STATE, [stamp_ns], metadata=metadata, state=[[x_m, 2.0]]
        )

    yield "two", [truth("/a-b/truth"), truth("/a_b/truth")], ("same name /a_b/truth in ROS", "--topic")
    yield "late", [truth("/truth", 2**31 * 10**9)], ("/truth", "after 2038-01-19", "export it as csv")
    yield "empty", [truth("/truth", x_m=np.nan)], ("no finite poses", "export it as csv")


@pytest.mark.parametrize(
    ("name", "streams", "words"), [*_bad_logs()], ids=lambda each: each if isinstance(each, str) else ""
)
def test_what_ros_cannot_state_is_refused(
    name: str, streams: list[fl.Stream], words: tuple[str, ...], fuselog: Fuselog
) -> None:
    fl.write(f"{name}.mcap", streams)
    said = fuselog("export", f"{name}.mcap", "--to", "ros2")
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    assert all(word in said.err for word in (f"{name}.mcap", *words)), said.err
    assert [path.name for path in Path().iterdir()] == [f"{name}.mcap"]
