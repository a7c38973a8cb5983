"""Alarms: a replay, an evaluation and a run say themselves what makes their numbers doubtful."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuselog.pipeline.api.api import record
from fuselog.pipeline.api.replays import replay
from fuselog.recorders.log import Stream, write_log
from fuselog.replay.engine.streams.sources import MemorySource
from tests.pipeline.conftest import Said

pytestmark = pytest.mark.usefixtures("blank_figures")

TRUTH, PRIOR, SIGHTINGS = "/robot1/truth", "/robot1/prior", "/robot1/range_bearing"


@pytest.fixture(scope="module")
def log() -> MemorySource:
    return record("landmarks", seed=5, duration_s=30.0)


def _with(log: MemorySource, stream: Stream) -> MemorySource:
    return MemorySource({**log.streams, stream.topic: stream}, log.run, log.name)


def _truth_moved(log: MemorySource, by: Callable[[Any, Any], Any]) -> MemorySource:
    """The truth moved by what `by` gives of its headings and of times from 0 to 1."""
    truth = log[TRUTH]
    state = truth["state"].copy()
    state[:, :2] += np.stack(by(state[:, 2], np.linspace(0.0, 1.0, len(state))), axis=1)
    return _with(log, replace(truth, columns={**truth.columns, "state": state}))


def _other_origin(_: Any, time: Any) -> Any:
    return np.full_like(time, 0.65), np.full_like(time, -0.3)


@pytest.mark.paper
def test_no_alarm_where_all_is_well(log: MemorySource) -> None:
    assert not replay(log, ["ekf", "ukf", "smoother:ekf", "smoother:iterated"]).alarms
    assert not replay(record("vehicles", seed=7), ["ekf", "vehicle-kalman"]).alarms


def test_a_run_that_dominates_the_mean_nees_is_named(log: MemorySource) -> None:
    """The truth of one of three runs is of another origin for a tenth of the time."""
    logs = [
        log,
        record("landmarks", seed=6, duration_s=30.0),
        record("landmarks", seed=7, duration_s=30.0),
    ]
    late = _truth_moved(logs[1], lambda _, time: (np.where(time > 0.9, 0.5, 0.0), 0.0 * time))
    [found] = [each for each in replay([logs[0], late, logs[2]], "ekf").alarms if each.kind == "errors"]
    assert "; run 1 dominates the mean with " in found.sentence
    assert not any("dominates" in each.sentence for each in replay([late], "ekf").alarms)


def test_what_a_method_cannot_estimate_is_named_in_place_of_its_consequences() -> None:
    """Points all about a target tell a UKF nothing of its size, and the analytic moments all."""
    found = replay(record("extended-target", seed=1), ["ukf", "lrkf", "analytic"]).alarms
    assert [(each.kind, each.where) for each in found] == [
        ("uninformed", "ukf"),
        ("uninformed", "lrkf"),
    ]
    assert found[0].sentence.startswith(
        "ukf: half_x_m, half_y_m keep their initial value and prior uncertainty, because no"
    )
    [biased, *_] = replay(record("moving-los", seed=1, duration_s=10.0), ["ekf"]).alarms
    assert biased.kind == "errors"
    assert (
        "the truth contains sensor_1_yaw_bias_rad and 11 more, which the estimator does not estimate"
        in biased.sentence
    )


def test_the_worst_is_said_first(
    log: MemorySource, tmp_path: Path, fuselog: Callable[..., Said]
) -> None:
    """By replay, evaluate and run, in words and in JSON, and by Python."""
    path, estimates = tmp_path / "run.mcap", tmp_path / "est.mcap"
    write_log(path, log.streams.values(), log.run)
    wrong = ["--set", "sigma_range_m=1e-4"]
    words = "doubtful: ekf robot1: the gate rejects 9"
    commands = {
        "replay": ["replay", path, "-e", "ekf", *wrong, "-o", estimates],
        "evaluate": ["evaluate", estimates],
        "run": ["run", path, "-e", "ekf", *wrong, "--out", tmp_path / "result"],
    }
    for name, command in commands.items():
        said = fuselog(*command)
        assert said.out.lstrip().startswith(words), name
        assert "% of" in said.out.splitlines()[0]
        assert "NIS is" in said.out.splitlines()[0]
        assert "also doubtful: ekf robot1: NEES is" in said.out, name
        stated = tmp_path / "result" / "result.json"
        found = json.loads(stated.read_text()) if name == "run" else fuselog(*command, "--json").json
        worst = found["alarms"][0]
        assert (worst["kind"], worst["estimator"], worst["case"]) == ("innovations", "ekf", "robot1")
        assert worst["excess"] > 1000
    page = tmp_path / "page.html"
    assert fuselog("report", tmp_path / "result", "-o", page).code == 0
    assert "<li>ekf robot1: the gate rejects 9" in page.read_text(encoding="utf-8")
    assert "<li>ekf robot1: NEES is" in page.read_text(encoding="utf-8")
    done = replay(log, "ekf", set={"sigma_range_m": 1e-4})
    assert done.alarms[0].sentence in repr(done)


@pytest.mark.parametrize(
    ("by", "kind", "offset"),
    [
        (_other_origin, "origin", "(-0.6"),
        (lambda h, _: (0.5 * np.cos(h), 0.5 * np.sin(h)), "lever arm", "(-0.498,"),
        (lambda _, time: (3.0 * time, 0.0 * time), "errors", "NEES is"),
        (lambda _, time: (3.0 * np.sin(9.0 * time), 0.0 * time), "errors", "NEES is"),
    ],
    ids=["other origin", "lever arm", "drift", "wave"],
)
def test_an_error_that_stays(log: MemorySource, by: Any, kind: str, offset: str) -> None:
    [alarm] = replay(_truth_moved(log, by), "ekf").alarms
    assert alarm.kind == kind
    assert offset in alarm.sentence


def test_an_aligned_estimate_has_no_other_origin(
    log: MemorySource, tmp_path: Path, fuselog: Callable[..., Said]
) -> None:
    moved = _truth_moved(log, _other_origin)
    write_log(tmp_path / "run.mcap", moved.streams.values(), moved.run)
    fuselog("replay", tmp_path / "run.mcap", "-e", "ekf", "-o", tmp_path / "est.mcap")
    said = fuselog("evaluate", tmp_path / "est.mcap")
    assert "different origins; try fuselog evaluate --align se2" in said.out.splitlines()[0]
    assert "doubtful" not in fuselog("evaluate", tmp_path / "est.mcap", "--align", "se2").out


def test_measurements_before_a_late_prior_are_counted(log: MemorySource) -> None:
    prior, stamps_ns = log[PRIOR], log[SIGHTINGS].publish_time_ns
    late_ns = prior.publish_time_ns + 5_000_000_000
    done = replay(_with(log, replace(prior, publish_time_ns=late_ns)), "ekf")
    before = int((stamps_ns < late_ns[0]).sum())
    assert (
        f"ekf: {SIGHTINGS}: {before} of {len(stamps_ns)} not used: {before} come before the prior"
        in [alarm.sentence for alarm in done.alarms if alarm.kind == "unused"]
    )


def test_a_likelihood_of_nothing(log: MemorySource) -> None:
    far = replace(log[PRIOR], columns={**log[PRIOR].columns, "mean": log[PRIOR]["mean"] + 100.0})
    worst = replay(_with(log, far), "ekf").alarms[0]
    assert "the gate rejects 100 % of" in worst.sentence
    assert "its log-likelihood includes no measurement" in worst.sentence


def test_gates_that_differ(log: MemorySource) -> None:
    opened = {"open": {"kind": "ekf", "gate_probability": 1.0}}
    last = replay(log, ["ekf", opened], set={"sigma_range_m": 0.05}).alarms[-1]
    assert last.kind == "gates"
    assert "gate_probability is 0.999 for ekf, 1 for open" in last.sentence


def test_a_minimum_that_is_not_the_least(log: MemorySource) -> None:
    """By the cost itself, whose residuals leave about half a unit for each measured number."""
    far = replay(log, "smoother:iterated", set={"start": "prior"})
    [alarm] = [each for each in far.alarms if each.kind == "minimum"]
    assert "try other starts, such as --set start=motion" in alarm.sentence
    assert alarm.value > 10.0
