"""Trajectories from the command line and from Python: files, estimates of logs, result folders."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import fuselog as fl
from fuselog.recorders.log import open_log, read_streams, write_log
from fuselog.recorders.recording import record_run
from fuselog.recorders.trajectories import Trajectory, tum_lines
from tests.conftest import without_drawing

Fuselog = Callable[..., Any]
STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def spiral(name: str, noise_m: float = 0.0) -> Trajectory:
    time_s = np.linspace(0, 20, 201)
    generator = np.random.default_rng(3)
    position_m = np.stack([time_s * np.cos(time_s), time_s * np.sin(time_s), 0.1 * time_s], axis=1)
    noisy = position_m + generator.normal(scale=noise_m, size=position_m.shape)
    rotation = Rotation.from_euler("z", time_s[:, None]).as_matrix()
    return Trajectory(name, noisy, rotation, np.rint(time_s * 1e9).astype(np.int64))


def turned(truth: Trajectory, noise_m: float, seed: int) -> Trajectory:
    """An estimate with white errors of its positions, in a frame of its own."""
    own = Rotation.from_rotvec([0.3, -0.2, 1.1])
    noise = np.random.default_rng(seed).normal(0.0, noise_m, truth.position_m.shape)
    assert truth.rotation is not None
    position_m, rotation = own.apply(truth.position_m + noise), own.as_matrix() @ truth.rotation
    return replace(truth, name="estimate", position_m=position_m, rotation=rotation)


@pytest.mark.parametrize("written", [[0.0, 0.0, 0.0], [0.4, -0.2, 0.8]])
def test_a_truth_of_positions_has_no_rotation_errors(written: list[float]) -> None:
    """Identity, or another orientation that never turns: RPE is that of the positions."""
    truth = spiral("truth")
    one = Rotation.from_rotvec(written).as_matrix()
    placed = replace(truth, rotation=np.tile(one, (len(truth), 1, 1)))
    done = fl.evaluate(turned(truth, 0.01, 0), truth=placed, align="se3", delta=2.0, delta_unit="m")
    assert not [name for name in done.metrics if "rotation" in name]
    assert done.metrics["rpe_translation_rmse_m"] == pytest.approx(0.01 * np.sqrt(6), rel=0.2)
    assert "orientations are constant" in done.notes[0]
    right = fl.evaluate(turned(truth, 0.01, 0), truth=truth, align="se3", delta=2.0, delta_unit="m")
    assert "ape_rotation_rmse_deg" in right.metrics
    assert not right.notes
    along = replace(placed, position_m=np.outer(np.arange(len(truth)), [0.1, 0.0, 0.0]))
    straight = fl.evaluate(along, truth=along)  # what drives straight on need not turn
    assert straight.metrics["ape_rotation_max_deg"] == pytest.approx(0.0, abs=1e-5)


def test_the_interval_of_an_alignment_is_that_of_its_rotation() -> None:
    """A path that is straight but for 0.3 m: of 100 alignments the stated 95 % hold about so many."""
    time_s = np.linspace(0.0, 20.0, 101)
    place = np.stack([time_s, 0.3 * np.sin(time_s), 0.1 * np.cos(2.0 * time_s)], axis=1)
    still = np.tile(np.eye(3), (101, 1, 1))
    path = Trajectory("truth", place, still, np.rint(time_s * 1e9).astype(np.int64))
    truth = replace(path, rotation=Rotation.from_euler("z", 0.1 * time_s[:, None]).as_matrix())
    within, stated = 0, []
    for seed in range(100):
        done = fl.evaluate(turned(truth, 0.2, seed), truth=truth, align="se3")
        [note] = done.notes
        stated.append(float(note.partition("within ")[2].split()[0]))
        away = done.compared.alignment.rotation @ Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
        about_x = np.degrees(Rotation.from_matrix(away).as_rotvec()[0])
        within += abs(about_x) < stated[-1]
    assert 88 <= within <= 100
    assert 5.0 < np.mean(stated) < 20.0
    rests = replace(truth, position_m=1e-3 * np.random.default_rng(1).normal(size=place.shape))
    [note] = fl.evaluate(turned(rests, 0.05, 0), truth=rests, align="se3").notes
    assert "not at all" in note


@pytest.mark.paper
def test_two_files(fuselog: Fuselog) -> None:
    """The keys and numbers that programs read; the same from Python; figures, tables and a report."""
    truth, estimate = spiral("truth"), spiral("estimate", 0.05)
    turn = Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix()
    moved = replace(estimate, position_m=estimate.position_m @ turn.T, rotation=turn @ estimate.rotation)
    for each in (truth, moved):
        Path(f"{each.name}.txt").write_text("\n".join(tum_lines(each)))
    options = ("--align", "se3", "--delta", "2", "--delta-unit", "m", "--out", "judged")
    said = fuselog("evaluate", "estimate.txt", "--truth", "truth.txt", *options, "--json").json
    errors = (
        ("ape_translation", "m"),
        ("ape_rotation", "deg"),
        ("rpe_translation", "m"),
        ("rpe_rotation", "deg"),
    )
    keys = [f"{error}_{each}_{unit}" for error, unit in errors for each in STATISTICS]
    assert list(said["metrics"]) == [*keys, "poses", "poses_without_truth", "rpe_pairs"]
    assert said["metrics"]["ape_translation_rmse_m"] == pytest.approx(0.05 * np.sqrt(3), rel=0.1)
    assert said["metrics"]["ape_rotation_rmse_deg"] == pytest.approx(0.0, abs=0.2)
    assert said["alignment"]["rotation"] == pytest.approx(
        Rotation.from_matrix(turn.T).as_quat(scalar_first=True), abs=2e-3
    )
    how = {"align": "se3", "delta": 2.0, "delta_unit": "m"}
    done = fl.evaluate("estimate.txt", truth=truth, **how)
    assert done.metrics == pytest.approx(said["metrics"], rel=1e-12)
    result = json.loads(Path("judged/result.json").read_text())
    assert result["metrics"] == said["metrics"]
    assert result["settings"]["align"] == "se3"
    for name in ("trajectory", "pose-errors", "error-along-path-estimate"):
        assert Path(f"judged/figures/{name}.svg").stat().st_size > 10_000
    with without_drawing():
        folder = done.save("again")
    assert len(folder.tables["poses"]) == 201
    assert np.sqrt(np.mean(folder.tables["pairs"]["rpe_translation_m"] ** 2)) == pytest.approx(
        said["metrics"]["rpe_translation_rmse_m"]
    )
    assert fuselog("report", "judged", "-o", "page.html").code == 0
    assert "ape_translation_rmse_m" in Path("page.html").read_text(encoding="utf-8")
    options = ("--align", "sim3", "--time-offset", "estimate")
    in_time = fuselog("evaluate", "estimate.txt", "--truth", "truth.txt", *options)
    assert "no time offset makes the error smaller; none was added" in in_time.err
    late = replace(moved, time_ns=moved.time_ns + 300_000_000)
    Path("late.txt").write_text("\n".join(tum_lines(late)))
    table = fuselog("evaluate", "late.txt", "--truth", "truth.txt", *options).out
    for words in ("APE translation (m)", " poses, ", "s were added to the stamps", "were scaled by "):
        assert words in table


@pytest.mark.paper
@pytest.mark.usefixtures("blank_figures")
def test_estimates_of_a_log_in_another_frame(fuselog: Fuselog) -> None:
    """Where the truth is turned, shifted and scaled, the aligned judgement is the same."""
    recording, run = record_run("landmarks", {"duration_s": 5.0}, 3)
    write_log("log.mcap", recording.streams, run)
    assert fuselog("replay", "log.mcap", "-e", "ekf").code == 0
    plain = fuselog("evaluate", "log.estimates.mcap", "--json").json["metrics"]
    for align, scale in (("se2", 1.0), ("sim3", 3.0)):
        ours = fuselog("evaluate", "log.estimates.mcap", "--align", align, "--json").json["metrics"]
        turn = Rotation.from_rotvec([0, 0, 2.0]).as_matrix()[:2, :2]
        moved = []
        for stream in recording.streams:
            if stream.topic == "/robot1/truth":
                state = stream["state"].copy()
                state[:, :2] = scale * state[:, :2] @ turn.T + [100.0, -50.0]
                state[:, 2] = (state[:, 2] + 2.0 + np.pi) % (2 * np.pi) - np.pi
                stream = replace(stream, columns={**stream.columns, "state": state})
            moved.append(stream)
        write_log("moved.mcap", moved, run)
        command = ("evaluate", "log.estimates.mcap", "--log", "moved.mcap")
        apart = fuselog(*command, "--json").json["metrics"]
        assert apart["ekf.nees.robot1"] > 1e3 * plain["ekf.nees.robot1"]
        said = fuselog(*command, "--align", align, "--out", "judged", "--json").json["metrics"]
        for key in ("ekf.nees.robot1", "ekf.position_nees.robot1", "ekf.ape_rotation_max_deg.robot1"):
            assert said[key] == pytest.approx(ours[key], rel=1e-6), key
        for key in ("position_rmse_m", "ape_translation_rmse_m", "rpe_translation_max_m"):
            assert said[f"ekf.{key}.robot1"] == pytest.approx(
                scale * ours[f"ekf.{key}.robot1"], rel=1e-6
            )
        assert said["ekf.position_rmse_m.robot1"] == pytest.approx(
            said["ekf.ape_translation_rmse_m.robot1"]
        )
    assert plain["ekf.position_rmse_m.robot1"] > ours["ekf.ape_translation_rmse_m.robot1"]
    figures = {path.name for path in Path("judged/figures").glob("*.svg")}
    assert {
        "trajectory-robot1.svg",
        "pose-errors-robot1.svg",
        "error-along-path-ekf-robot1.svg",
    } <= figures


@pytest.mark.parametrize("align", ["none", "yaw", "se2", "se3", "sim3"])
def test_numbers_that_cannot_be_squared_end_in_a_sentence(
    align: str, world: Path, tmp_path: Path, fuselog: Fuselog
) -> None:
    """1e308 m once gave half a document of JSON and a traceback, and its alignment came to no end."""
    path = tmp_path / "far.tum"
    path.write_text("".join(f"{time} 1e308 {time}e307 -1e308 0 0 0 1\n" for time in range(9)))
    said = fuselog("evaluate", path, "--truth", world / "line.tum", "--align", align, "--json")
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith(f"fuselog: {path}: has a position beyond 1e+100 m")


def test_estimates_that_cannot_be_squared_are_nulls(
    world: Path, tmp_path: Path, fuselog: Fuselog
) -> None:
    log = open_log(world / "log.estimates.mcap")
    streams = read_streams(log, list(log.topics))
    for topic, stream in streams.items():
        if "mean" in stream.columns:
            columns = {**stream.columns, "mean": np.full_like(stream["mean"], 1e308)}
            streams[topic] = replace(stream, columns=columns)
    path = tmp_path / "far.mcap"
    write_log(path, list(streams.values()), log.run)
    said = fuselog("evaluate", path, "--log", world / "log.mcap", "--json")
    assert (said.code, said.err) == (0, "")
    assert said.json["metrics"]["ekf.position_rmse_m.robot1"] is None
