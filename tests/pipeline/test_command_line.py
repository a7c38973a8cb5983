"""The command line end to end: record, look, replay, judge, run, report; and what may interrupt it."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.blueprint import View

import fuselog as fl
from fuselog.pipeline.api.lists import told as told_of
from fuselog.pipeline.logs.information import fitting_of
from fuselog.pipeline.output.results import result_folder
from fuselog.pipeline.runs.inputs import KEPT
from fuselog.recorders.log import RunMetadata, make_stream, open_log, read_streams, schemas, write_log
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.timeline.drawing.canvas import Scene
from tests.conftest import heeding_interrupts
from tests.faults.planted import SCENARIOS, recorded
from tests.lists import lists
from tests.lists import main as keep_lists
from tests.pipeline.conftest import run_here
from tests.replay.foreign.test_isolation import SANE, run_with
from tests.replay.foreign.test_programs import FAIL, PROGRAM, python

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
PLACE = {"components": "y_m,x_m", "kinds": "linear,linear"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_whole_way_from_a_scenario_to_a_report(here: Path, fuselog: Fuselog) -> None:
    """What the README promises in one go; the two ways to judge agree."""
    assert fuselog("record", "landmarks", "--set", "duration_s=5", "-o", "log.mcap").code == 0
    replayed = fuselog("replay", "log.mcap", "-e", "ekf", "-e", "dead-reckoning", "--json").json
    evaluated = fuselog("evaluate", "log.estimates.mcap", "--json", "--out", "judged").json
    assert replayed["written"] == ["log.estimates.mcap"]
    assert replayed["metrics"] == evaluated["metrics"]
    metrics = replayed["metrics"]
    assert metrics["ekf.position_rmse_m.robot1"] < metrics["dead-reckoning.position_rmse_m.robot1"]
    assert fuselog("report", "judged", "-o", "page.html").code == 0
    assert "ekf" in (here / "page.html").read_text()
    assert sorted(path.name for path in here.iterdir()) == [
        "judged",
        "log.estimates.mcap",
        "log.mcap",
        "page.html",
    ]


def test_a_run_is_recorded_again_from_its_log_and_from_its_estimates(
    here: Path, world: Path, fuselog: Fuselog
) -> None:
    assert fuselog("record", "--again", str(world / "log.mcap"), "-o", "again.mcap").code == 0
    assert (here / "again.mcap").read_bytes() == (world / "log.mcap").read_bytes()
    assert fuselog("record", "--again", str(world / "log.estimates.mcap"), "-o", "again.mcap").code == 0
    assert (here / "again.mcap").read_bytes() == (world / "log.mcap").read_bytes()
    assert fuselog("record", "--again", str(world / "log.mcap"), "--seed", "1", "-o", "1.mcap").code == 0
    assert (here / "1.mcap").read_bytes() == (world / "other.mcap").read_bytes()


@pytest.mark.usefixtures("here")
def test_another_run_of_a_recorded_one_has_its_parameters_and_its_seed(fuselog: Fuselog) -> None:
    """What is stated for the new one comes first."""
    one = ["landmarks", "--seed", 5, "--set", "duration_s=1", "--set", "landmarks=3"]
    assert fuselog("record", *one, "--run", 1, "-o", "1.mcap").code == 0
    for options in (["--run", 3], ["--run", 0], ["--run", 3, "--set", "landmarks=4"]):
        assert fuselog("record", *one, *options, "-o", "anew.mcap").code == 0
        assert fuselog("record", "--again", "1.mcap", *options, "-o", "again.mcap").code == 0
        assert Path("again.mcap").read_bytes() == Path("anew.mcap").read_bytes()
        run = open_log("again.mcap").run
        assert run is not None
        assert (run.seed, run.run) == (5, options[1])


@pytest.mark.usefixtures("here")
def test_a_shipped_scenario_sets_its_parameters(fuselog: Fuselog) -> None:
    """Late messages and outages come with `landmarks-adverse`, and --set still wins."""
    said = fuselog("record", "landmarks-adverse", "--set", "duration_s=5", "--set", "robots=1")
    assert said.code == 0
    log = open_log("landmarks-adverse.mcap")
    assert log.run is not None
    assert log.run.parameters["range_bearing"]["field_of_view_deg"] == 120.0
    assert not any(topic.startswith("/robot2") for topic in log.topics)
    seen = read_streams(log, ["/robot1/range_bearing"])["/robot1/range_bearing"]
    assert (seen.log_time_ns > seen.publish_time_ns).all()


def test_estimates_of_several_logs_equal_those_of_one(here: Path, world: Path, fuselog: Fuselog) -> None:
    """The runs of an ensemble do not touch each other, whichever way they are replayed."""
    logs = [str(world / "log.mcap"), str(world / "other.mcap")]
    assert fuselog("replay", *logs, "-e", "ekf", "--out", "both").code == 0
    for log in logs:
        assert fuselog("replay", log, "-e", "ekf", "--out", "each").code == 0
        name = Path(log).stem + ".estimates.mcap"
        both, each = open_log(here / "both" / name), open_log(here / "each" / name)
        assert list(both.topics) == list(each.topics)
        streams = read_streams(both, list(both.topics)), read_streams(each, list(each.topics))
        for topic in both.topics:
            for field, column in streams[0][topic].columns.items():
                np.testing.assert_array_equal(column, streams[1][topic][field])


def test_more_runs_than_are_replayed_at_once(
    here: Path, world: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand logs must not need a thousand open files: they are replayed in parts."""
    monkeypatch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", 1)
    logs = [str(world / "log.mcap"), str(world / "other.mcap")]
    in_parts = fuselog("replay", *logs, "-e", "ekf", "--out", "a", "--json").json["metrics"]
    monkeypatch.undo()
    at_once = fuselog("replay", *logs, "-e", "ekf", "--out", str(here / "b"), "--json").json["metrics"]
    assert at_once == pytest.approx(in_parts, rel=1e-14)  # sums of sums round otherwise


@pytest.mark.usefixtures("here")
def test_a_part_of_the_runs_that_cannot_start_fails_alone(
    world: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one run of an ensemble does; where no run of any part can start, that is bad input."""
    monkeypatch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", 1)
    good, bad = str(world / "log.mcap"), str(world / "bad-prior.mcap")
    said = fuselog("replay", good, bad, "-e", "ekf", "--out", "both", "--json")
    assert said.code == 0, said.err
    assert said.json["metrics"]["ekf.failed_runs.robot1"] == 1
    again = shutil.copy(bad, "again.mcap")
    none = fuselog("replay", bad, again, "-e", "ekf", "--out", "none")
    assert none.code == 2
    assert "not positive definite" in none.err


@pytest.mark.usefixtures("here")
def test_settings_reach_the_estimators_that_have_them(world: Path, fuselog: Fuselog) -> None:
    log, out = str(world / "log.mcap"), "estimates.mcap"
    every = ["replay", log, "-e", "ekf", "-e", "ukf", "-e", "e", "--set", "e.kind=ekf", "--out", out]
    both = ["--set", "bias_range_m=0.5", "--set", "kappa=1", "--set", "e.bias_range_m=0", "--json"]
    metrics = fuselog(*every, *both).json["metrics"]
    errors = {name: metrics[f"{name}.position_rmse_m.robot1"] for name in ("ekf", "ukf", "e")}
    assert errors["ekf"] > 2 * errors["e"]
    assert errors["ukf"] > 2 * errors["e"]
    settings = json.loads(open_log(out).run.notes["estimators"])  # type: ignore[union-attr]
    assert settings == {
        "ekf": {"bias_range_m": 0.5},
        "ukf": {"bias_range_m": 0.5, "kappa": 1},
        "e": {"kind": "ekf", "bias_range_m": 0},
    }


@pytest.mark.usefixtures("here")
def test_a_span_is_replayed_and_judged_alone(world: Path, fuselog: Fuselog) -> None:
    """Estimates lie within the span; the prior before it is still used."""
    span = ["--start", "0", "--end", "1"]
    assert fuselog("replay", str(world / "log.mcap"), "-e", "ekf", *span, "--out", "part.mcap").code == 0
    log = open_log("part.mcap")
    stamps_ns = read_streams(log, ["/estimates/ekf/robot1/pose"])[
        "/estimates/ekf/robot1/pose"
    ].publish_time_ns
    assert log.run is not None
    assert len(stamps_ns) > 0
    assert stamps_ns.max() < log.run.epoch_ns + 10**9


@pytest.mark.usefixtures("here")
def test_what_the_truth_lacks_is_said_once_and_the_rest_is_judged(world: Path, fuselog: Fuselog) -> None:
    """A truth without heading: position and its NEES of two components, for every estimator."""
    log = open_log(world / "log.mcap")
    streams = read_streams(log, list(log.topics))
    truth = streams["/robot1/truth"]
    streams["/robot1/truth"] = replace(
        truth, columns={**truth.columns, "state": truth["state"][:, 1::-1]}, metadata=PLACE
    )
    write_log("log.mcap", list(streams.values()), log.run)
    said = fuselog("replay", "log.mcap", "-e", "ekf", "-e", "ukf", "--save", "log.rrd", "--json")
    assert said.code == 0
    for name in ("ekf", "ukf"):
        assert said.err.count(f"{name} robot1: heading_rad is not judged: /robot1/truth lacks it") == 1
        assert said.json["metrics"][f"{name}.heading_rmse_rad.robot1"] is None
        assert said.json["metrics"][f"{name}.position_rmse_m.robot1"] < 0.1
        assert 0.2 < said.json["metrics"][f"{name}.nees.robot1"] < 6
    assert Path("log.rrd").exists()


@pytest.mark.usefixtures("here")
def test_estimates_beside_a_log_and_in_a_folder_find_it_again(world: Path, fuselog: Fuselog) -> None:
    """The log is named relative to its estimates, so that both can be moved together."""
    Path("a").mkdir()
    Path("a/log.mcap").write_bytes((world / "log.mcap").read_bytes())
    assert fuselog("replay", "a/log.mcap", "-e", "ekf", "--out", "a/b").code == 0
    Path("a").rename("ä ☃")
    assert fuselog("evaluate", "ä ☃/b/log.estimates.mcap").code == 0


def test_info_says_that_no_model_fits(
    tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lists no models that do not fit, and says how one of one's own is used."""
    monkeypatch.chdir(tmp_path)
    seen = {"metadata": {"components": "bob_m"}, "value": [[0.5]]}
    fl.write("own.mcap", [fl.make_stream("/p/camera", fl.schemas.VECTOR_MEASUREMENT, [10**9], **seen)])
    said = fuselog("info", "own.mcap").out.splitlines()[-1]
    assert said == (
        "No registered model fits this log: it has no topic that a registered model needs; use a model "
        'of your own from Python, fl.modelled(MODEL, "ekf"), or register it: see Your model in the '
        "documentation"
    )


def test_info_imports_every_model_that_fits() -> None:
    """Of logs of all scenarios: types that are kept leave out only models that do not fit."""
    fitting = set[str]()
    for scenario in SCENARIOS:
        topics = MemorySource(*recorded(scenario), scenario).topics
        whole, chosen = fitting_of(topics), fitting_of(topics, is_all=False)
        found, same = (
            {name: each for name, each in all_.items() if each.methods} for all_ in (whole, chosen)
        )
        assert found == same, scenario
        assert chosen.keys() == whole.keys()
        assert any(not each.lacks for name, each in chosen.items() if name not in found), scenario
        fitting |= found.keys()
    assert len(fitting) > 7


def test_info_names_the_tracker_of_detections(
    tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sensor = {"sigma_m": "2", "detection_probability": "0.9", "clutter_per_m2": "1e-4"}
    scans = {"metadata": sensor, "scan_id": [0], "detections": [1]}
    seen = {"scan_id": [0], "position_m": [[1.0, 2.0]]}
    streams = [
        fl.make_stream("/radar/scan", fl.schemas.SCAN, [10**9], **scans),
        fl.make_stream("/radar/detection", fl.schemas.DETECTION, [10**9], **seen),
    ]
    fl.write("seen.mcap", streams)
    said = fuselog("info", "seen.mcap").out
    assert "\n  without a model: -e gm-phd tracker; from " in said
    assert said.endswith("\nnext: fuselog replay seen.mcap -e gm-phd\n")
    assert "No registered model" not in said
    used = ["/radar/scan", "/radar/detection"]
    found = fuselog("info", "seen.mcap", "--json").json["estimators"]
    assert found == {"gm-phd": used, "tracker": used}


def test_info_names_no_estimator_that_a_replay_refuses(
    tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a unit without a magnetometer, by its values; with one, all that take nine axes."""
    monkeypatch.chdir(tmp_path)
    recorded = fl.record("navigation", duration_s=11.0)
    samples = recorded["/body/inertial"]
    field = np.tile([20.0, 0.0, -40.0], (len(samples), 1))
    whole = replace(samples, columns={**samples.columns, "magnetic_field_ut": field})
    found = []
    for stream in (samples, whole):
        fl.write("log.mcap", [stream])
        found.append(fuselog("info", "log.mcap", "--json").json["estimators"])
    assert found[0] == {}
    assert {"bingham-inertial", "gyro", "madgwick", "mahony", "triad", "vqf"} <= found[1].keys()


def test_info_names_the_estimators_of_what_a_fitting_model_leaves(
    tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fuselog("record", "vehicles", "--set", "duration_s=3").code == 0
    said = fuselog("info", "vehicles.mcap").out
    assert "  vehicle: -e ekf iekf" in said
    assert "  without a model: -e gm-phd; from /infrastructure/scan" in said
    assert "  without a model: -e vehicle-particles vehicles; from /vehicle1/prior" in said
    replay = ("replay", "vehicles.mcap", "-e")
    assert "did you mean 'gm-phd'?" in fuselog(*replay, "GM-PHD").err
    assert "--set ukf: ukf is not among the replayed estimators (ekf); add -e ukf" in (
        fuselog(*replay, "ekf", "--set", "ukf.gate_probability=1").err
    )


def test_info_says_what_a_person_asks(world: Path, fuselog: Fuselog) -> None:
    said = fuselog("info", str(world / "two-robots.mcap")).out
    for words in ("landmarks, seed 0, run 0", "duration_s = 2.0", "robots = 2", "2 s from 2026-01-01"):
        assert words in said
    assert "speed_mps" not in said  # as by default
    topics = {
        row["topic"]: row for row in fuselog("info", str(world / "log.mcap"), "--json").json["topics"]
    }
    assert topics["/robot1/odometry"]["messages"] == 40
    assert topics["/robot1/truth"]["metadata"]["components"] == "x_m,y_m,heading_rad"
    lossy = fuselog("info", str(world / "cut.mcap"), "--recover")
    assert lossy.code == 0
    assert "cut off" in lossy.err


@cache
def both_lists(kind: str) -> tuple[list[dict[str, Any]], str]:
    """A list for machines, and for a person."""
    return run_here(kind, "--json").json, run_here(kind).out


@pytest.mark.paper
@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("scenarios", "landmarks-adverse", ["outages_per_minute", "fuselog record landmarks-adverse"]),
        ("scenarios", "mrclam", ["sigma_range_m", "fuselog import mrclam PATH"]),
        ("estimators", "ukf", ["gate_probability", "number > 0 <= 1", "/landmarks"]),
        ("estimators", "tracker", ["tracker:VALUE sets association: nearest, hungarian, jpda"]),
        ("estimators", "vehicles", ["unscented-powers, products or complex", "registration or static"]),
        ("metrics", "consistency", ["NEES"]),
        (
            "models",
            "robot",
            [
                "state: x_m, y_m, heading_rad (angle)",
                "sensor bearing: bearing_rad (angle) of /landmarks",
                "control odometry: forward_mps, turn_radps",
                "sigma_range_m",
                "by ukf: yes",
                "by analytic: no: it lacks exact moments of its motion",
            ],
        ),
        ("experiments", "landmarks", ["dead-reckoning, ekf, ukf", "100 runs"]),
    ],
)
def test_lists_and_details(kind: str, name: str, words: list[str], fuselog: Fuselog) -> None:
    listed, printed = both_lists(kind)
    assert name in [row["name"] for row in listed]
    assert name in printed
    details = fuselog(kind, name)
    assert details.code == 0
    for word in words:
        assert word in details.out
    assert fuselog(kind, name, "--json").json == [row for row in listed if row["name"] == name]


def test_lists_that_are_kept_are_what_modules_and_files_say() -> None:
    """`python -m tests.lists` keeps them."""
    assert json.loads(KEPT.read_text(encoding="utf-8")) == lists()


def test_lists_are_not_kept_if_an_entry_does_not_load(
    fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The lists show its error; `python -m tests.lists` does not keep that as its description."""
    before = KEPT.read_bytes()
    broken = {"broken": EntryPoint("broken", "nowhere:METRIC", "fuselog.metrics")}
    for module in ("fuselog.recorders.registry", "fuselog.pipeline.api.catalog"):
        monkeypatch.setattr(f"{module}.available", lambda _: broken)
    why = "metric 'broken' (nowhere:METRIC)"
    assert told_of("metrics")["broken"].startswith(why)
    assert fuselog("metrics", "--json").json[0]["what"].startswith(why)
    named = fuselog("metrics", "broken")
    assert (named.code, why in named.err) == (2, True)
    monkeypatch.setattr("tests.lists.GROUPS", {"metrics": "metrics"})
    with pytest.raises(SystemExit, match="2"):
        keep_lists()
    assert capsys.readouterr().err.startswith(f"nothing is kept: {why}")
    assert KEPT.read_bytes() == before


def test_the_formulas_of_a_model_are_printed(fuselog: Fuselog) -> None:
    assert fuselog("models", "vehicle", "--formulas").out == fl.formulas("vehicle") + "\n"
    told = fuselog("models", "vehicle", "--formulas", "--json").json
    assert told["formulas"]["mode drive, move"][0].startswith("v1 = ")
    assert "did you mean 'robot'?" in fuselog("models", "robt", "--formulas").err
    assert "--formulas needs a model" in fuselog("models", "--formulas").err


def test_models_are_listed_with_the_methods_that_estimate_them(fuselog: Fuselog) -> None:
    """The table names them within 100 columns; JSON and the details say why others cannot."""
    listed = {
        row["name"]: {
            key.removeprefix("by_"): said for key, said in row.items() if key.startswith("by_")
        }
        for row in fuselog("models", "--json").json
    }
    methods = ("ekf", "iekf", "ukf", "lrkf", "analytic", "sqrt", "smoother", "imm", "particles", "bound")
    no_angle = "no: it lacks an angle or an orientation in its state, along which to split its prior"
    assert listed["vehicle"] == {**dict.fromkeys(methods, "yes"), "bank": no_angle}
    assert listed["robot"]["bank"] == "yes"
    table = fuselog("models").out
    assert max(map(len, table.splitlines())) <= 100
    _, _, rows = table.partition("methods that estimate it")
    for name, cells in listed.items():
        (row,) = re.findall(rf"^ {name} +(.*)$", rows, re.MULTILINE)
        assert row.split() == [method for method, said in cells.items() if said == "yes"]


@pytest.mark.parametrize("kind", ["scenarios", "models", "estimators"])
def test_lists_are_grouped_by_family(kind: str) -> None:
    """Every name is there once, and ours belong to families that have a title."""
    lines = both_lists(kind)[1].splitlines()
    names = [words[0] for line in lines if line.startswith("   ") and (words := line.split())]
    assert sorted(names) == sorted(getattr(fl, kind))
    assert not [line for line in lines if "Other packages" in line]
    families = [line.strip() for line in lines if re.match(" [A-Z]", line)]
    assert len(families) == len({*families}) >= 4


@pytest.mark.usefixtures("here")
def test_observability_of_a_log_is_a_command(world: Path, fuselog: Fuselog) -> None:
    """For a person and for machines; what cannot be asked is one sentence."""
    told = fuselog("observability", str(world / "log.mcap"), "--window", "2", "--scale", "x_m=0.5")
    rows = fuselog(
        "observability", str(world / "log.mcap"), "--window", "2", "--scale", "x_m=0.5", "--json"
    ).json
    assert {row["case"] for row in rows} == {"robot1"}
    assert all(row["rank"] == 3 == len(row["eigenvalues"]) for row in rows)
    assert all(row["weakest"] in told.out for row in rows)
    for option, sentence in (
        ("--window=0", "--window 0: expected a positive number of seconds"),
        ("--scale=x=1", "x_m"),
    ):
        said = fuselog("observability", str(world / "log.mcap"), option)
        assert said.code == 2
        assert sentence in said.err


@pytest.mark.usefixtures("here")
def test_the_model_and_the_interval_of_estimates_are_options(world: Path, fuselog: Fuselog) -> None:
    """They reach every label that has them; --set of one label is stronger."""
    log, out = str(world / "log.mcap"), "estimates.mcap"
    every = ["replay", log, "-e", "ekf", "-e", "dead-reckoning", "-e", "e", "--set", "e.kind=ekf"]
    more = ["--set", "e.every_s=0.5", "--model", "robot", "--every", "0.01", "--out", out, "--json"]
    metrics = fuselog(*every, *more).json["metrics"]
    likely = pytest.approx(metrics["e.log_likelihood.robot1"], rel=1e-4)
    assert metrics["ekf.log_likelihood.robot1"] == likely != 0
    settings = json.loads(open_log(out).run.notes["estimators"])  # type: ignore[union-attr]
    assert settings == {
        "ekf": {"model": "robot", "every_s": 0.01},
        "dead-reckoning": {"every_s": 0.01},
        "e": {"kind": "ekf", "model": "robot", "every_s": 0.5},
    }
    topics = [f"/estimates/{name}/robot1/pose" for name in ("ekf", "dead-reckoning", "e")]
    poses = read_streams(open_log(out), topics)
    ekf, reckoning, e = (np.diff(poses[topic].publish_time_ns).max() * 1e-9 for topic in topics)
    assert ekf == reckoning == pytest.approx(0.01)
    assert e > 0.04


def test_help_imports_nothing_heavy() -> None:
    """--help answers at once: what takes long to import waits for a command that needs it."""
    code = (
        "import sys; from fuselog.pipeline.command_line import main; code = main(['--help']); "
        "print(code, *{'numpy', 'numba', 'rerun', 'pandas', 'pydantic', 'rich'} & set(sys.modules))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert "Record, replay" in said
    assert said.splitlines()[-1] == "0"


THREAD_AT_WORK = """
import atexit, io, sys, threading, time

begun, goes_on = threading.Event(), threading.Event()

class Slow(io.RawIOBase):
    def writable(self):
        return True

    def write(self, data):
        begun.set()
        time.sleep(60.0)
        return len(data)

def work():
    goes_on.wait()
    print("said as the process ends", file=sys.stderr, flush=True)

def clear():
    goes_on.set()
    begun.wait()
    print("cleared away")

sys.stderr = io.TextIOWrapper(io.BufferedWriter(Slow()))
atexit.register(clear)  # before logging's own, so that it is called after that
threading.Thread(target=work, daemon=DAEMON).start()

from fuselog.pipeline.command_line import main
sys.exit(main())
"""


@pytest.mark.parametrize("is_daemon", [True, False])
def test_a_thread_at_work_does_not_spoil_the_end(is_daemon: bool) -> None:
    """It holds the lock of standard error, at which Python's own end aborts, or waits for the thread."""
    code = THREAD_AT_WORK.replace("DAEMON", str(is_daemon))
    command = [sys.executable, "-c", code, "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30.0)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.endswith("\ncleared away\n")


FAILS = """
import sys, threading, time
from fuselog.pipeline.command_line import main, process

process.fuselog = lambda *_, **__: 1 / 0
threading.Thread(target=time.sleep, args=[60.0]).start()
sys.exit(main())
"""


def test_an_unexpected_error_ends_beside_a_thread_at_work_too() -> None:
    command = [sys.executable, "-c", FAILS]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30.0)
    assert ended.returncode == 1
    assert ended.stderr.startswith("Traceback ")
    assert ended.stderr.endswith("\nZeroDivisionError: division by zero\n")


# What takes long to import, and is for drawing, for tables or for one family alone.
HEAVY = (
    *("matplotlib", "rerun", "pandas", "pyarrow", "sklearn", "h5py", "rosbags.typesys", "rich.progress"),
    "scipy",
)
# What compiles and loads kernels; logs are read by kernels, too, but never by numba's.
KERNELS = ("numba", "fuselog.recorders.compiling.kernels.native")

# What reading a log needs nothing of: what recorded it, how files are written, and other kinds of logs.
RECORDED = ("fuselog.recorders.simulators.landmarks", "filelock", "rosbags")

# What a list needs nothing of: what it lists.
LISTED = (
    *HEAVY,
    *KERNELS,
    "fuselog.recorders.simulators.landmarks",
    "fuselog.replay.inference",
    "fuselog.pipeline.studies",
)


# In one process, one after the other: each may import what those before it may not.
NEEDLESS = {
    **dict.fromkeys(["scenarios", "estimators", "models", "metrics", "experiments"], LISTED),
    "info log.mcap": (*HEAVY, "numba", "concurrent.futures.process", *RECORDED),
    "replay log.mcap -e ekf -e ukf": (*HEAVY, "fuselog.pipeline.runs.experiment"),
    "scenarios landmarks": HEAVY,
    "estimators ekf": (),
    "run landmarks --parameters": HEAVY,  # what `run` imports before its workers begin
    "replay log.mcap -e ekf --save drawn.rrd": ("matplotlib", "scipy"),
}


@pytest.mark.paper
@pytest.mark.usefixtures("here")
def test_a_command_imports_nothing_heavy_that_it_does_not_need(world: Path) -> None:
    shutil.copy(world / "log.mcap", "log.mcap")
    code = (
        "import sys; from fuselog.pipeline.command_line import main; imported = []\n"
        f"for command, needless in {NEEDLESS}.items():\n"
        "    imported += [main(command.split()), {*needless} & sys.modules.keys()]\n"
        "print(imported)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == str([0, set()] * len(NEEDLESS))


@pytest.mark.paper
@pytest.mark.usefixtures("here")
def test_output_in_a_narrow_terminal_and_beyond_its_encoding(
    world: Path, start_fuselog: Callable[..., subprocess.Popen[str]]
) -> None:
    name = "ä ☃.mcap"
    Path(name).write_bytes((world / "log.mcap").read_bytes())
    narrow = {**os.environ, "COLUMNS": "60", "PYTHONIOENCODING": "ascii"}
    process = start_fuselog("replay", name, "-e", "ekf", "-e", "dead-reckoning", env=narrow)
    out, err = process.communicate()
    assert process.returncode == 0
    assert err == ""
    *lines, written, _ = out.splitlines()
    others = [line for line in lines if not line.startswith("nees: the value is from one run, ")]
    assert max(map(len, others)) <= 60
    assert written == r"\xe4 \u2603.estimates.mcap"


@pytest.mark.paper
def test_a_reader_that_goes_away_is_no_error(world: Path, start_fuselog: Callable[..., Any]) -> None:
    """`fuselog info log.mcap | head -0` says nothing on standard error."""
    reading, writing = os.pipe()
    os.close(reading)
    process = start_fuselog("info", str(world / "log.mcap"), stdout=writing)
    os.close(writing)
    assert process.communicate()[1] == ""
    assert process.returncode == 1


def _stop_when(pattern: str, process: Any, number: int) -> str:
    """Send a signal once a process has begun to write; what it says on standard error."""
    deadline = time.monotonic() + 60
    while not list(Path().glob(pattern)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(number)
    return str(process.communicate()[1])


@pytest.fixture
def parent_that_ignores_interrupts() -> Iterator[None]:
    """What runs the tests may do so."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.paper
@pytest.mark.unix
@pytest.mark.usefixtures("parent_that_ignores_interrupts")
def test_a_stopped_run_leaves_nothing_and_a_killed_one_a_part(
    here: Path, start_fuselog: Callable[..., Any], fuselog: Fuselog
) -> None:
    """What is in the place is whole; what a killed process left is cleared by the next.

    A termination is stopped the same way, see `test_a_stop_that_falls_into_a_finalizer_is_not_lost`.
    """
    long = ["run", "landmarks", "--runs", "100", "--out", "r"]  # of more, finished cells are kept
    process = start_fuselog(*long)
    assert _stop_when(".r.*.part/new", process, signal.SIGINT).strip() == "fuselog: stopped"
    assert process.returncode == 128 + signal.SIGINT
    assert list(here.iterdir()) == []
    process = start_fuselog(*long)
    _stop_when(".r.*.part/new", process, signal.SIGKILL)  # noqa: TID251
    assert [path.name[:3] for path in here.iterdir()] == [".r."]
    assert fuselog("run", "landmarks", "--runs", "1", "--set", "duration_s=1", "--out", "r").code == 0
    assert [path.name for path in here.iterdir()] == ["r"]


@pytest.mark.parametrize("command", ["record landmarks", "replay {log} -e ekf"])
def test_a_stopped_recording_or_replay_leaves_nothing(
    command: str, here: Path, world: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        assert list(here.glob(".new.mcap.*.part/new.mcap"))
        raise KeyboardInterrupt

    monkeypatch.setattr("fuselog.recorders.log.LogWriter.write", stop)
    said = fuselog(*command.format(log=world / "log.mcap").split(), "--out", "new.mcap")
    assert said.code == 130
    assert said.err.strip() == "fuselog: stopped"
    assert list(here.iterdir()) == []


@pytest.mark.unix
@pytest.mark.parametrize(
    ("number", "again"), [(signal.SIGINT, False), (signal.SIGINT, True), (signal.SIGTERM, False)]
)
@pytest.mark.paper
def test_a_stop_that_falls_into_a_finalizer_is_not_lost(
    number: int, again: bool, here: Path, world: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python prints what a finalizer raises and goes on; a person who pressed Ctrl-C would wait.

    Nor is the next one, which may fall into the hook that sends the first again.
    """

    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(number)

    def finalize(*_: object) -> None:
        Finalized()  # nobody holds it
        for _ in range(100):
            time.sleep(0.05)
        raise AssertionError("nothing stopped it")

    class Timer(threading.Timer):
        def start(self) -> None:
            if again and not sent:
                sent.append(number)
                signal.raise_signal(number)
            super().start()

    sent = list[int]()
    monkeypatch.setattr("threading.Timer", Timer)
    monkeypatch.setattr("fuselog.recorders.log.LogWriter.write", finalize)
    with heeding_interrupts():
        said = fuselog("replay", world / "log.mcap", "-e", "ekf", "--out", "new.mcap")
    assert (said.code, said.err.strip()) == (128 + number, "fuselog: stopped")
    assert list(here.iterdir()) == []


@pytest.mark.usefixtures("here")
def test_two_runs_into_one_folder_do_not_mix(fuselog: Fuselog) -> None:
    with result_folder(Path("r")) as theirs:
        said = fuselog("run", "landmarks", "--runs", "1", "--set", "duration_s=1", "--out", "r")
        assert said.code == 2
        assert "another fuselog command is writing it" in said.err
        assert theirs.exists()


@pytest.mark.usefixtures("here")
def test_what_is_in_a_log_never_steers_the_terminal(fuselog: Fuselog) -> None:
    """Metadata and notes with escape sequences: they are shown, not obeyed."""
    evil = "\x1b]0;gone\x07\x1b[2J\u202e\x9b31m"
    stream = make_stream(
        "/odometry",
        schemas.ODOMETRY,
        [0],
        forward_mps=[1.0],
        turn_radps=[0.0],
        metadata={evil: evil},
    )
    write_log("log.mcap", [stream], RunMetadata(evil, {evil: evil}, notes={evil: evil}))
    for command in (
        "info log.mcap",
        "replay log.mcap -e ekf",
        "record --again log.mcap",
        "view log.mcap",
    ):
        said = fuselog(*command.split())
        for text in (said.out, said.err):
            assert text.replace("\n", "").isprintable()
    assert r"\x1b[2J\u202e" in fuselog("info", "log.mcap").out


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("experiment", ["landmarks", "torus-propagation"])
def test_runs_without_end_say_what_they_would_take(experiment: str, fuselog: Fuselog) -> None:
    said = fuselog("run", experiment, "--runs", str(10**12))
    assert said.code == 2
    assert re.search(r"1000000000000 runs of .* need at least .* GB of memory", said.err)
    assert list(Path().iterdir()) == []


@pytest.mark.paper
@pytest.mark.usefixtures("here")
def test_names_beyond_the_locale_and_variables_of_rerun(world: Path) -> None:
    """In the C locale, a name that is not ASCII reaches Python, Rerun and Arrow in three ways.

    Rerun's own variables neither leave a timeline empty nor write to stderr.
    """
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    plain |= {"RERUN": "off", "RERUN_FLUSH_NUM_ROWS": "x"}
    code = (
        "import sys; from fuselog.pipeline.command_line import main\n"
        "log, folder, timeline = sys.argv[1:]\n"
        "from matplotlib.figure import Figure; Figure.draw = lambda *_: None\n"
        "run = main(['run', 'landmarks', '--runs', '1', '--set', 'duration_s=1', '--out', folder])\n"
        "print(run, *[main(['view', log, '--save', timeline]) for _ in range(2)])"
    )
    names = [str(world / "log.mcap"), "ä", "ü.rrd"]
    said = subprocess.run(
        [sys.executable, "-c", code, *names], env=plain, capture_output=True, text=True, check=True
    )
    assert said.stderr == ""
    assert said.stdout.splitlines()[-1] == "0 0 0"
    assert {path.name for path in Path().iterdir()} == {"ä", "ü.rrd"}
    assert all(each.stat().st_size > 1000 for each in (Path("ü.rrd"), Path("ä/timeline.rrd")))


@pytest.mark.paper
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full to write to")
def test_a_full_standard_output_is_said(world: Path, start_fuselog: Callable[..., Any]) -> None:
    with Path("/dev/full").open("w") as full:
        process = start_fuselog("info", str(world / "log.mcap"), stdout=full)
    assert process.communicate()[1] == "fuselog: standard output: No space left on device\n"
    assert process.returncode == 2


@pytest.mark.paper
@pytest.mark.usefixtures("here")
def test_each_command_prints_the_next(fuselog: Fuselog) -> None:
    """From the README's first command on to a report, only by what is printed."""
    page = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^fuselog (record .*?) +#", page, re.MULTILINE)
    more = {"record": "--set duration_s=5", "view": "--save seen.rrd", "run": "--set duration_s=2"}
    went = []
    while (words := shlex.split(command))[0] not in went:
        went.append(words[0])
        said = fuselog(*words, *more.get(words[0], "").split())
        assert said.code == 0, said.err
        command = said.out.splitlines()[-1].removeprefix("next: fuselog ")
    assert went == ["record", "info", "replay", "view", "run", "report"]
    assert command == "view out/landmarks"


@pytest.mark.usefixtures("here")
def test_info_of_what_fuselog_made(world: Path, fuselog: Fuselog) -> None:
    """Of an estimates log, of a result folder and of its timeline."""
    estimates, result = world / "log.estimates.mcap", world / "result"
    said = fuselog("info", str(estimates)).out.splitlines()[-2]
    assert said.startswith("Estimates by ekf of log.mcap: use view, evaluate")
    said = fuselog("info", str(result)).out
    assert "a result of landmarks (" in said
    assert "dead-reckoning, ekf and ukf over 2 simulated runs of 2 s (scenario landmarks)" in said
    assert fuselog("info", str(result), "--json").json["experiment"] == "landmarks"
    timeline = result / "timeline.rrd"
    assert "a timeline of fuselog-landmarks" in fuselog("info", str(timeline)).out
    entities = fuselog("info", str(timeline), "--json").json["entities"]
    assert entities["/map/robot1/truth/path"] > 1
    Path("none.rrd").write_text("no timeline")
    refused = fuselog("info", "none.rrd")
    assert (refused.code, "none.rrd: cannot be read as a timeline" in refused.err) == (2, True)


@pytest.mark.usefixtures("here")
def test_the_run_that_a_result_shows_is_saved(world: Path, fuselog: Fuselog) -> None:
    result = world / "result"
    said = fuselog("view", str(result), "--save", "shown.rrd")
    assert (said.code, said.out.splitlines()[0], said.err) == (0, "shown.rrd", "")
    assert Path("shown.rrd").read_bytes() == (result / "timeline.rrd").read_bytes()
    refused = fuselog("view", str(result), "--save", "shown.rrd", "--start", "1")
    assert (refused.code, "--start, --end, --focus and --connect need a log" in refused.err) == (2, True)
    refused = fuselog("view", str(result), "--save", "shown.rrd", "--at", "worst")
    assert (refused.code, "--at worst: sets the time cursor of the viewer" in refused.err) == (2, True)


@pytest.mark.usefixtures("here")
def test_a_view_opens_at_the_moment_that_a_replay_names(
    fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two robots, that of the moment is seen first; unless another one is asked for."""
    fuselog("record", "landmarks", "--set", "robots=2", "--set", "duration_s=2", "-o", "two.mcap")
    names = ("-e", "ekf", "-e", "ukf", "-o", "est.mcap")
    worst = fuselog("replay", "two.mcap", *names, "--json").json["worst"]
    said = fuselog("replay", "two.mcap", *names).out.splitlines()
    seen: list[Any] = []

    def picture(*_: object, at_s: float, progress: object) -> list[str]:
        seen.append(at_s)
        return []

    def draw_cases(scene: Scene, draw_case: Callable[[str], View]) -> View:
        seen.append(scene.focus)
        return draw_case(scene.cases[0])

    monkeypatch.setattr("fuselog.replay.timeline.viewer.screenshot", picture)
    monkeypatch.setattr("fuselog.replay.timeline.landmarks.draw_cases", draw_cases)
    for name in ("ekf", "ukf"):
        moment = worst[name]
        shown = fuselog("view", "est.mcap", "--at", f"worst:{name}", "--screenshot", "a.png")
        line, written, _ = shown.out.splitlines()
        assert (line in said, line.startswith(f"{name}: worst at ")) == (True, True)
        assert (written, seen) == ("a.png", [moment["case"], moment["elapsed_s"]])
        seen.clear()
    other = {"robot1": "robot2", "robot2": "robot1"}[worst["ekf"]["case"]]
    shown = fuselog("view", "est.mcap", "--at", "worst", "--focus", other, "--screenshot", "a.png")
    assert (shown.code, seen[0]) == (0, other)
    assert f" of {other}: NEES " in shown.out


@pytest.mark.usefixtures("here")
def test_parameters_are_printed_on_request(world: Path, fuselog: Fuselog) -> None:
    """Defaults too, and those that were given."""
    log = str(world / "log.mcap")
    asked = ["-e", "ekf", "-e", "ukf", "--set", "ukf.kappa=1", "--out"]
    assert "kappa" not in fuselog("replay", log, *asked, "a.mcap").out
    [row] = [
        line
        for line in fuselog("replay", log, *asked, "b.mcap", "--parameters").out.splitlines()
        if line.split()[:1] == ["kappa"]
    ]
    assert row.split() == ["kappa", "1"]
    told = fuselog("replay", log, *asked, "c.mcap", "--json").json["parameters"]
    assert told["ukf"] == {**told["ekf"], "kappa": 1.0}
    said = fuselog("run", log, "-e", "ukf", "--parameters", "--out", "d").out
    assert "kappa" in said
    assert not Path("d").exists()  # nothing was run
    assert "position_rmse_m" not in said
    alone = fuselog("run", "landmarks", "--set", "ukf.kappa=2", "--parameters", "--json").json
    assert alone["parameters"]["ukf"]["kappa"] == 2.0


@pytest.mark.usefixtures("here")
def test_parameters_that_a_log_states_are_shown_with_their_channel(
    world: Path, fuselog: Fuselog
) -> None:
    """What is given counts, else what the log says: with the noise of its recording."""
    replay = ("replay", str(world / "noisy.mcap"), "-e", "ekf", "--out", "a.mcap")
    printed = fuselog(*replay, "--parameters").out
    assert re.search(r"^ sigma_range_m +1\.0 \(/robot1/range_bearing\)", printed, re.MULTILINE)
    assert "ekf, from the log" in printed
    given = fuselog(*replay, "--set", "sigma_range_m=0.5", "--json").json
    assert given["parameters"]["ekf"]["sigma_range_m"] == 0.5
    assert given["parameters_of_log"]["ekf"].keys() >= {"sigma_bearing_rad", "turn_noise_density"}
    assert "sigma_range_m" not in given["parameters_of_log"]["ekf"]
    model = fuselog("models", "robot").out
    assert re.search(r"^ sigma_range_m +from the log ", model, re.MULTILINE)
    assert re.search(r"^ inflate_nis +number", model, re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        (
            "NUMBA_CPU_NAME",
            "bogus",
            "LLVM cannot compile for this ('bogus' is not a recognized processor",
        ),
        ("NUMBA_CPU_FEATURES", "+bogus", "LLVM cannot compile for this ("),
        ("NUMBA_NUM_THREADS", "0", "expected a number of cores, 1 or more"),
        ("SOURCE_DATE_EPOCH", "x", "expected whole seconds since 1970"),
        ("FUSELOG_UNCOMPILED", "yes", "expected 1"),
    ],
)
def test_an_environment_variable_that_cannot_be_is_named(
    name: str, value: str, expected: str, fuselog: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    said = fuselog("metrics")
    assert said.code == 2
    assert said.err.startswith(f"fuselog: {name}={value}: {expected}")
    assert said.err.count("\n") == 1


def test_a_replay_whose_only_run_failed_fails_a_build(fuselog: Fuselog, tmp_path: Path) -> None:
    """Of two runs one estimate is left, and of a folder each log is a run."""
    for each in (SANE, float(FAIL)):
        folder = tmp_path / f"{each:g}"
        folder.mkdir()
        fl.write(folder / f"{each:g}.mcap", run_with(each))
    estimator = ("-e", f"exec:{python(PROGRAM)}")
    sane, failed = tmp_path / "1", tmp_path / f"{FAIL}"
    for folders, code in (((failed,), 1), ((sane,), 0), ((sane, failed), 0)):
        said = fuselog("replay", *folders, *estimator, "--out", tmp_path / "out")
        assert (said.code, "it was told to fail" in said.err) == (code, failed in folders)


def test_errors_beyond_any_covariance_are_called_divergence(
    here: Path, fuselog: Fuselog, world: Path
) -> None:
    """A hundred standard deviations are a matter of covariances, a hundred thousand are not.

    Then one sentence has NIS and NEES, so that it gives one reason.
    """
    small, far = "its covariances are too small", "it diverged"
    for sigma_m, told in ((1e-3, [(small, 1), (small, 1)]), (1e-6, [(far, 2)])):
        own = ("--set", f"sigma_range_m={sigma_m}", "--set", "gate_probability=1")
        said = fuselog("replay", world / "log.mcap", "-e", "ekf", *own, "--out", here / "e.mcap")
        assert said.code == 0
        lines = [line for line in said.out.splitlines() if "NIS is" in line or "NEES is" in line]
        found = [
            (why, line.count(" is between ")) for line in lines for why in (small, far) if why in line
        ]
        assert found == told, said.out


def test_a_log_that_is_replaced_by_one_of_other_settings_is_named(
    fuselog: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what differs; nothing is said where the same command made it."""
    monkeypatch.chdir(tmp_path)
    record = ("record", "landmarks", "--set", "duration_s=2", "-o", "a.mcap", "--seed")
    replay = ("replay", "a.mcap", "--set", "sigma_range_m=0.3", "-e")
    assert fuselog(*record, "1").err == fuselog(*record, "1").err == ""
    assert fuselog(*record, "2").err == (
        "fuselog: a.mcap: replaced a log with other settings: seed = 1, now 2\n"
    )
    assert "replaced" not in fuselog(*replay, "ekf").err + fuselog(*replay, "ekf").err
    assert (
        'a.estimates.mcap: replaced a log with other settings: estimators = ["ekf"], now ["ekf", "ukf"];'
        ' ukf = not set, now {"sigma_range_m": 0.3}'
    ) in fuselog(*replay, "ekf", "-e", "ukf").err
