"""Logs as files of other tools: every number arrives, and nothing that is there is replaced."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.writer import Writer
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import fuselog as fl

Fuselog = Callable[..., Any]
POSE, TRUTH = "/estimates/ekf/robot1/pose", "/robot1/truth"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_trajectories_for_evo(world: Path, fuselog: Fuselog) -> None:
    """The files alone, read by another reader, give the RMSE of the replay and of `evaluate`."""
    for name in ("log", "log.estimates"):
        assert fuselog("export", world / f"{name}.mcap", "--to", "tum").code == 0
    assert [path.name for path in Path("log-tum").iterdir()] == ["robot1-truth.txt"]
    files = Path("log-tum/robot1-truth.txt"), Path("log.estimates-tum/estimates-ekf-robot1-pose.txt")
    truth, estimate = (np.loadtxt(path) for path in files)
    assert_array_equal(truth[:, 0], estimate[:, 0])
    rmse_m = np.sqrt(np.mean(np.sum((truth - estimate)[:, 1:4] ** 2, axis=1)))
    ours = fuselog("evaluate", world / "log.estimates.mcap", "--json").json["metrics"]
    of_files = fuselog("evaluate", files[1], "--truth", files[0], "--json").json["metrics"]
    assert rmse_m == pytest.approx(ours["ekf.position_rmse_m.robot1"], abs=1e-12)
    assert rmse_m == pytest.approx(of_files["ape_translation_rmse_m"], abs=1e-12)
    heading_deg = np.degrees(ours["ekf.heading_rmse_rad.robot1"])
    assert of_files["ape_rotation_rmse_deg"] == pytest.approx(heading_deg, rel=1e-6)
    assert fuselog("export", world / "log.mcap", "--to", "kitti", "-o", "k", "--topic", TRUTH).code == 2
    done = fl.export(world / "log.mcap", to="kitti", out="truth.txt", topics=[TRUTH])
    assert done == ({TRUTH: Path("truth.txt")}, [])
    state = fl.open(world / "log.mcap")[TRUTH]["state"]
    matrix = np.loadtxt("truth.txt").reshape(-1, 3, 4)
    assert_array_equal(matrix[:, :2, 3], state[:, :2])
    assert_allclose(np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0]), state[:, 2], atol=1e-15)


def test_poses_are_trajectories(fuselog: Fuselog) -> None:
    """Of any topic; what is not finite is left out, and said."""
    turn = np.array([[0.5, 0.5, -0.5, 0.5], [1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.0, 0.8]])
    place = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, 5.0, 6.0]])
    columns = {"position_m": place, "quaternion": turn, "covariance": np.zeros((3, 36))}
    poses = fl.make_stream("/mocap/body", fl.schemas.POSE, np.arange(3) * 10**9, **columns)
    fl.write("log.mcap", [poses])
    said = fuselog("export", "log.mcap", "--to", "tum")
    assert "1 poses are not finite" in said.err
    assert_allclose(
        np.loadtxt("log-tum/mocap-body.txt"),
        [[0, 1, 2, 3, 0.5, -0.5, 0.5, 0.5], [2, 4, 5, 6, 0.0, 0.0, 0.8, 0.6]],
    )


def test_a_trajectory_goes_through_a_log_and_back(fuselog: Fuselog) -> None:
    """Stamps to the nanosecond, positions to the last digit, rotations to the digits written."""
    rng = np.random.default_rng(4)
    quaternions = Rotation.random(50, rng=rng).as_quat()
    stamps_ns = 1_403_636_579_763_555_584 + np.cumsum(rng.integers(1, 10**9, 50))
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{number:.7f}" for number in pose)
        for stamp, pose in zip(
            stamps_ns.tolist(), np.hstack([1e3 * rng.normal(size=(50, 3)), quaternions]), strict=True
        )
    ]
    Path("way.txt").write_text("\n".join(lines))
    imported = fuselog("import", "table", "way.txt", "--mapping", "tum", "-o", "log.mcap")
    assert "read as TUM (8 numbers: time in s" in imported.out
    assert fuselog("export", "log.mcap", "--to", "tum", "-o", "back.txt", "--topic", "/truth").code == 0
    given, back = (np.genfromtxt(name, dtype=str) for name in ("way.txt", "back.txt"))
    assert_array_equal(back[:, 0], given[:, 0])
    assert_array_equal(back[:, 1:4].astype(float), given[:, 1:4].astype(float))
    apart = Rotation.from_quat(back[:, 4:].astype(float)) * Rotation.from_quat(quaternions).inv()
    assert apart.magnitude().max() < 4e-7


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_tables(to: Any, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every column of every stream, over many blocks; an empty one has a header."""
    whole = fl.open(world / "log.mcap")
    nothing = replace(whole["/landmarks"].take(slice(0, 0)), topic="/nothing/at all")
    fl.write("log.mcap", [*(whole[topic] for topic in whole), nothing])
    import fuselog.pipeline.logs.exporting as exporting

    read = exporting.read_blocks
    monkeypatch.setattr(exporting, "read_blocks", lambda *given: read(*given, block_messages=20))
    done = fl.export("log.mcap", to=to)
    assert set(done.files) == {*whole, "/nothing/at all"}
    assert done.files["/nothing/at all"] == Path(f"log-{to}/nothing-at all.{to}")
    for topic, path in done.files.items():
        found = pd.read_csv(path) if to == "csv" else pd.read_parquet(path)
        if topic in whole:
            pd.testing.assert_frame_equal(
                found, whole[topic].pandas(), check_dtype=to != "csv", rtol=1e-15
            )
        else:
            assert (len(found), list(found)[:2]) == (0, ["publish_time_ns", "log_time_ns"])


def test_a_log_without_numbers_is_said_to_have_none(fuselog: Fuselog) -> None:
    with Path("log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("own", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/own", "json", schema), 1, b"{}", 1)
        writer.finish()
    said = fuselog("export", "log.mcap", "--to", "csv")
    assert said.code == 2
    assert "has no topic of numeric messages" in said.err
    assert "topic /own is own in the encoding 'json'" in said.err
    assert "export it as csv" not in said.err


def test_what_a_pose_lacks_is_said() -> None:
    states = np.array([[1.0, 2.0], [np.nan, 1.0], [3.0, 4.0]])
    metadata = {"components": "x_m,y_m", "kinds": "linear,linear"}
    truth = fl.make_stream(
        "/truth", fl.schemas.TRUTH_STATE, [0, 10, 20], metadata=metadata, state=states
    )
    fl.write("log.mcap", [truth])
    done = fl.export("log.mcap", to="tum")
    assert done.notes == [
        "/truth: has no orientation; the identity is written instead",
        "/truth: 1 poses are not finite and were omitted",
    ]
    assert done.files["/truth"].read_text().splitlines()[1:] == [
        "0.000000000 1.0 2.0 0.0 0.0 0.0 0.0 1.0",
        "0.000000020 3.0 4.0 0.0 0.0 0.0 0.0 1.0",
    ]


def test_nothing_is_replaced(world: Path, fuselog: Fuselog) -> None:
    command = ("export", world / "log.mcap", "--to", "tum")
    assert fuselog(*command).code == 0
    Path("own.txt").write_text("mine")
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    for options, words in (
        ((), ("log-tum", "exists", "--out")),
        (("-o", "own.txt"), ("own.txt", "exists", "--out")),
        (("-o", "own.txt", "--topic", TRUTH), ("own.txt", "exists", "another name")),
        (("-o", "own.csv", "--topic", TRUTH), ("own.csv", "ends in .txt")),
        (("--topic", "/robot1/trth"), ("no topic /robot1/trth", "did you mean '/robot1/truth'")),
        (
            ("--topic", "/robot1/odometry"),
            ("/robot1/odometry", "is not an estimate, truth or Pose", "csv"),
        ),
        (("--to", "tmu"), ("'tmu'", "'kitti'")),
    ):
        said = fuselog(*command, *options)
        assert said.code == 2
        assert said.out == ""
        assert said.err.count("\n") == 1
        assert all(word in said.err for word in words), said.err
    said = fuselog("export", world / "no-truth.mcap", "--to", "tum")
    assert (said.code, "no estimates, truths or poses" in said.err) == (2, True)
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
