"""The public interface: `import fuselog`, and its functions in place of the commands."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rerun.chunk import RrdReader

import fuselog as fl
from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.output.results import read_result
from fuselog.replay.engine.replaying.estimator import Estimator

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
LOCAL = (ROOT / "docs" / "your-estimator.md").read_text(encoding="utf-8")
SHORT = {"duration_s": 4.0}
POSE = "/estimates/ekf/robot1/pose"
Fuselog = Callable[..., Any]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def recordings() -> list[fl.MemorySource]:
    return [fl.record("landmarks", seed=3, run=run, **SHORT) for run in range(2)]


def robot() -> fl.Model:
    from fuselog.replay.estimators.landmarks import ROBOT

    return ROBOT


def blocks_of(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def python(code: str, *folders: Path) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own, with folders in front of all others that are searched."""
    paths = f"import sys; sys.path[:0] = {[*map(str, folders), str(ROOT)]}\n"
    return subprocess.run([sys.executable, "-c", paths + code], capture_output=True, text=True)


@pytest.mark.paper
def test_the_page_works_as_written(capsys: pytest.CaptureFixture[str]) -> None:
    """The study of 20 lines says what it should, and all that follows runs."""
    study, *others = blocks_of(PAGE)
    assert len([line for line in study.splitlines() if line]) <= 20
    names: dict[str, Any] = {}
    exec(study, names)
    metrics = names["replay"].metrics.set_index(["estimator", "quantity"])["value"]
    rmse = [metrics[label, "position_rmse_m"] for label in ("ekf", "ukf", "own")]
    assert rmse[0] == pytest.approx(rmse[1], rel=0.01)
    assert 0.1 < rmse[2] < 1.0 < 20 * rmse[0] + 1.0
    assert metrics["own", "estimated_share"] == 1.0
    assert Path("errors.png").stat().st_size > 10_000
    assert len(RrdReader("timeline.rrd").recordings()) == 1
    exec("\n".join(others), names)
    assert names["late"].estimates[0][POSE].publish_time_ns[0] == names["log"].epoch_ns + 10 * 10**9
    assert re.search(r"/robot1/odometry +600 fuselog.Odometry", capsys.readouterr().out)


@pytest.mark.paper
def test_estimates_last_as_long_as_any_of_them_is_referred_to(collect: Callable[[], int]) -> None:
    """Also in one line, where nothing refers to the replay; the folder goes with the last of them."""
    log = fl.record("landmarks", seed=3, duration_s=2.0)
    estimates = fl.replay(log, "ekf").estimates[0]
    collect()
    assert len(estimates[POSE]) > 0
    place = estimates.log.path  # type: ignore[union-attr]
    del estimates
    collect()
    assert not place.exists()


def test_importing_brings_nothing_heavy() -> None:
    """So that it is quick; `make bench` measures commands."""
    done = python(
        "import fuselog\n"
        "print(*{'numba', 'numpy', 'pandas', 'rerun', 'matplotlib', 'pydantic'} & sys.modules.keys())"
    )
    assert done.stdout.split() == []


def test_every_name_of_the_stub_is_there() -> None:
    stub = ast.parse((ROOT / "fuselog" / "__init__.pyi").read_text(encoding="utf-8"))
    named = [each.name for node in stub.body if isinstance(node, ast.ImportFrom) for each in node.names]
    assert sorted(named) == dir(fl) == sorted(fl.__all__)
    assert all(getattr(fl, name) is not None for name in named)
    with pytest.raises(AttributeError, match="no attribute 'replays'"):
        _ = fl.replays  # type: ignore[attr-defined]


def test_plug_ins_import_from_fuselog_alone() -> None:
    """Beside NumPy, pydantic and what Python itself has."""
    pages = [LOCAL, PAGE, (ROOT / "README.md").read_text(encoding="utf-8")]
    imported = {
        line.split()[1]
        for page in pages
        for block in blocks_of(page)
        for line in block.splitlines()
        if re.match(r"(from|import) ", line)
    }
    assert imported - sys.stdlib_module_names == {"fuselog", "numpy", "pydantic"}


@pytest.mark.paper
def test_a_user_may_have_modules_of_the_same_names(tmp_path: Path) -> None:
    """Of our rooms, beside a script that uses both."""
    names = "pipeline", "recorders", "replay"
    (tmp_path / "recorders").mkdir()
    for file in ("pipeline.py", "recorders/__init__.py", "replay.py"):
        (tmp_path / file).write_text("OWN = 1")
    (tmp_path / "script.py").write_text(
        f"import fuselog as fl, {', '.join(names)}\n"
        "from fuselog.replay.judging.judge import Judge\n"  # a folder that has the function's name
        "done = fl.replay(fl.record('landmarks', duration_s=1.0), 'ekf')\n"
        f"print({'.OWN, '.join(names)}.OWN, len(done.estimates))\n"
    )
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("1 1 1 1\n", "")


def test_streams_are_tables(monkeypatch: pytest.MonkeyPatch, recordings: list[fl.MemorySource]) -> None:
    prior = recordings[0]["/robot1/prior"]
    table = prior.pandas()
    assert list(table) == [
        *(
            "publish_time_ns",
            "log_time_ns",
            "sensor_time_ns",
            "mean_x_m",
            "mean_y_m",
            "mean_heading_rad",
        ),
        *(f"covariance_{entry}" for entry in range(9)),
    ]
    assert table["mean_y_m"].tolist() == prior["mean"][:, 1].tolist()
    pd.testing.assert_frame_equal(prior.arrow().to_pandas(), table)
    monkeypatch.setitem(
        sys.modules, "polars", SimpleNamespace(from_arrow=lambda arrow: ("polars", arrow))
    )
    assert prior.polars() == ("polars", prior.arrow())
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(
        fl.BadInput, match=r"polars is not installed: run pip install polars, or use \.pandas"
    ):
        prior.polars()


def test_logs_are_mappings(recordings: list[fl.MemorySource]) -> None:
    fl.write("run.mcap", recordings[0])
    log = fl.open("run.mcap")
    assert "/robot1/truth" in log
    assert log.get("/robot7/truth") is None
    assert set(log) == set(recordings[0])
    for topic, stream in log.items():
        for name, column in stream.columns.items():
            np.testing.assert_array_equal(column, recordings[0][topic][name])
    with pytest.raises(
        fl.BadInput, match=r"^run\.mcap: no topic /robot1/truht; did you mean '/robot1/truth'"
    ):
        log["/robot1/truht"]


def test_a_recording_is_written_as_the_command_writes_it(fuselog: Fuselog) -> None:
    recorded = fl.record("landmarks-adverse", seed=5, run=2, **SHORT)
    fl.write("here.mcap", recorded)
    fl.write("here.mcap", recorded)
    fuselog(
        *[
            "record",
            "landmarks-adverse",
            "--seed",
            "5",
            "--run",
            "2",
            "--set",
            "duration_s=4",
            "-o",
            "there.mcap",
        ]
    )
    assert Path("here.mcap").read_bytes() == Path("there.mcap").read_bytes()
    Path("mine.mcap").write_text("not a log")
    with pytest.raises(fl.BadInput, match=r"mine\.mcap: exists and is not a log that fuselog wrote"):
        fl.write("mine.mcap", recorded)


@pytest.mark.paper
@pytest.mark.usefixtures("blank_figures")
def test_a_replay_says_what_the_command_says(
    fuselog: Fuselog, recordings: list[fl.MemorySource]
) -> None:
    """Of logs and of recordings, whole and in part; its tables and estimates say so too."""
    for run, recording in enumerate(recordings):
        fl.write(f"{run}.mcap", recording)
    logs, span = ["0.mcap", "1.mcap"], "--start 1 --end 3 --start-from truth --start-sigma x_m=0.5"
    for options, given in {
        "": {},
        span: {"start_s": 1.0, "end_s": 3.0, "start_from": "truth", "start_sigma": {"x_m": 0.5}},
        "--arrival-order": {"arrival_order": True},
    }.items():
        told = fuselog(
            "replay", *logs, *["-e", "ekf", "-e", "dead-reckoning", "--json"], *options.split()
        ).json
        for form in (logs, recordings):
            done = fl.replay(form, ["ekf", "dead-reckoning"], **given)
            case = done.metrics["case"].map(lambda name: f".{name}" if name else "")
            keys = done.metrics["estimator"] + "." + done.metrics["quantity"] + case
            assert dict(zip(keys, done.metrics["value"], strict=True)) == told["metrics"]
            stated = done.metrics.assign(key=keys).dropna(subset=["low", "high"])
            intervals = stated[["low", "high"]].to_numpy().tolist()
            assert dict(zip(stated["key"], intervals, strict=True)) == told["bounds"]
            assert {"nees", "nis_per_component"} <= set(stated["quantity"])
            for run, estimates in enumerate(done.estimates):
                there = fl.open(f"{run}.estimates.mcap")
                assert set(there) == set(estimates)
                np.testing.assert_array_equal(there[POSE]["mean"], estimates[POSE]["mean"])
            errors = done.errors[done.errors["estimator"] == "ekf"]
            squares = errors["error_x_m"] ** 2 + errors["error_y_m"] ** 2
            rmse = np.sqrt(squares.groupby(errors["run"]).mean())
            expected = done.runs.set_index(["estimator", "run"]).loc["ekf", "position_rmse_m"]
            np.testing.assert_allclose(rmse, expected, rtol=1e-12)
            nis = done.innovations["nis"].sum() / done.innovations["degrees"].sum()
            assert nis == pytest.approx(told["metrics"]["ekf.nis_per_component.robot1"])
    assert (done.failures, done.losses, done.steps["runs"].max()) == ([], [], 2)
    saved = done.save("result")
    pd.testing.assert_frame_equal(saved.tables["runs"], done.runs)
    assert fuselog("report", "result").code == 0


def test_an_estimator_needs_no_registration(recordings: list[fl.MemorySource]) -> None:
    """A model with a method is what the registered estimator is, with settings too."""
    from fuselog.replay.estimators.dead_reckoning import DEAD_RECKONING

    assert isinstance(DEAD_RECKONING, Estimator)
    mine, wide = fl.modelled(robot(), "ekf"), {"sigma_range_m": 0.4}
    own = {"mine": mine, "wide": {"kind": mine, **wide}, "same": {"kind": "ekf", **wide}}
    done = fl.replay(recordings, ["ekf", own, {"reckoned": DEAD_RECKONING}])
    values = done.metrics.pivot_table("value", "quantity", "estimator")
    assert values["mine"].equals(values["ekf"])
    assert values["wide"].equals(values["same"])
    assert not values["wide"].equals(values["ekf"])
    stated = json.loads(done.estimates[0].run.notes["estimators"])  # type: ignore[union-attr]
    assert stated["wide"] == {"kind": str(mine), **wide}
    assert "reckoned" in repr(done)


def test_a_run_has_its_likelihood_nis_and_gated_share(recordings: list[fl.MemorySource]) -> None:
    """In the order of the estimators; what has no innovations has none of it."""
    done = fl.replay(recordings, ["ekf", "dead-reckoning"])
    whole = done.metrics.set_index(["estimator", "quantity"])["value"]
    runs = done.runs.set_index("estimator")
    assert list(dict.fromkeys(runs.index)) == ["ekf", "dead-reckoning"]
    own = runs.loc["ekf"]
    assert own["log_likelihood"].mean() == pytest.approx(whole["ekf", "log_likelihood"])
    measured = done.innovations.groupby("run")
    counted = measured["nis"].sum() / measured["degrees"].sum()
    assert own["nis_per_component"].tolist() == pytest.approx(counted.tolist())
    gated = 1.0 - measured["accepted"].mean()
    assert own["gated_share"].tolist() == pytest.approx(gated.tolist())
    assert runs.loc["dead-reckoning", "log_likelihood"].isna().all()


def test_a_ukf_is_a_regression_of_the_same_kappa(recordings: list[fl.MemorySource]) -> None:
    """The two have other defaults, as their meanings say."""
    kinds = {
        "u": "ukf",
        "l": "lrkf:ukf",
        "u-half": {"kind": "ukf", "kappa": 0.5},
        "l-zero": "lrkf:ukf:kappa=0",
    }
    own = {label: kind if isinstance(kind, dict) else {"kind": kind} for label, kind in kinds.items()}
    nees = fl.replay(recordings, own).metrics.pivot_table("value", "quantity", "estimator").loc["nees"]
    assert nees["u"] == nees["l-zero"] != nees["l"] == nees["u-half"]


def test_an_estimator_needs_no_label(recordings: list[fl.MemorySource]) -> None:
    """In replay, tune and diagnose it has the name of its method."""
    bare = fl.modelled(robot(), "ekf")
    done, by_name = (fl.replay(recordings, each, metrics=None) for each in (bare, "ekf"))
    pd.testing.assert_frame_equal(done.metrics, by_name.metrics)
    with pytest.raises(fl.BadInput, match="estimator ekf is given twice"):
        fl.replay(recordings, [bare, bare])
    with pytest.raises(fl.BadInput, match="a model without a method is not an estimator; give modelled"):
        fl.replay(recordings, robot())
    assert fl.diagnose(recordings[0], bare).label == "ekf"
    assert fl.tune(recordings, bare, "sigma_range_m", grid=1).label == "ekf"


def test_a_component_that_was_not_measured_is_nan(recordings: list[fl.MemorySource]) -> None:
    """Of a schema that ships, as of one of one's own: the other component is used."""
    log, topic = recordings[0], "/robot1/range_bearing"
    sightings = log[topic]
    bearing = np.where(np.arange(len(sightings)) % 2, sightings["bearing_rad"], np.nan)
    half = replace(sightings, columns={**sightings.columns, "bearing_rad": bearing})
    fl.write("half.mcap", [*(log[each] for each in log if each != topic), half])
    done = fl.replay("half.mcap", "ekf")
    row = done.coverage.iloc[0]
    assert row["used"] + row["gated"] == len(sightings)
    innovation = done.estimates[0]["/estimates/ekf/robot1/innovation"]["innovation"]
    assert np.isnan(innovation).sum(axis=0).tolist() == [0, (len(sightings) + 1) // 2]


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    "method",
    ["smoother:ekf:lag=500ms", "smoother:iterated", "particles:10", "bound:smoother", "imm:ekf"],
)
def test_a_model_of_ones_own_has_every_method(method: str, recordings: list[fl.MemorySource]) -> None:
    """What is not registered, tied to a method by its name, is replayed as the command replays it."""
    from fuselog.replay.families.vehicles.vehicle_model import VEHICLE

    has_modes = method.startswith("imm")
    logs = [fl.record("manoeuvres", **SHORT)] if has_modes else recordings[:1]
    mine = fl.modelled(replace(VEHICLE if has_modes else robot(), summary="mine"), method)
    assert str(mine).startswith("mine, ")
    assert str(mine).endswith(f"({method})")
    values = fl.replay(logs, [method, {"mine": mine}]).metrics.pivot_table(
        "value", ["quantity", "case"], "estimator"
    )
    assert len(values) > 2
    assert values["mine"].equals(values[method])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda _: fl.open("nope.mcap"), "nope.mcap: cannot be read"),
        (lambda _: fl.record("landmark"), "did you mean 'landmarks'"),
        (
            lambda _: fl.record("landmarks", duration=1.0),
            "no parameter 'duration'; did you mean 'duration_s'",
        ),
        (lambda _: fl.import_("mrclam", "nope"), "nope: no such file or folder"),
        (lambda _: fl.run("landmark"), "did you mean 'landmarks'"),
        (lambda _: fl.run("landmarks", set={"robot": 2}), "--set robot: not an entry"),
        (lambda _: fl.write("a.mcap", [1]), "a.mcap: these are no streams; give streams"),
        (lambda _: fl.estimators["ekff"], "no estimator 'ekff'; did you mean 'ekf'"),
        (lambda _: fl.modelled(object(), "ekff"), "no method 'ekff'; did you mean 'ekf'"),
        (lambda _: fl.modelled(robot(), "ekf:9"), "method ekf has no variants; give 'ekf' without ':9'"),
        (
            lambda _: fl.modelled(robot(), "smoother:ekg"),
            "method smoother:ekg: 'ekg' is not a filter that",
        ),
        (lambda _: fl.modelled(robot(), "lrkf:s2kf"), "sampling 's2kf': count: is missing"),
        (
            lambda _: fl.modelled(robot(), "particles:0"),
            "method particles:0: parameter 'particles' is '0'",
        ),
        (
            lambda _: fl.modelled(robot(), "imm:ekf"),
            "method imm:ekf: the model lacks several modes, which this method needs",
        ),
        (lambda runs: fl.replay(runs, "ekff"), "no estimator 'ekff'; did you mean 'ekf'"),
        (lambda runs: fl.replay(runs, {"ekf": {"sigma": 1}}), "estimator ekf: no parameter 'sigma'"),
        (lambda runs: fl.replay(runs, {"a": print}), "estimator a is a builtin_function_or_method"),
        (
            lambda runs: fl.replay(runs, {"kind": fl.modelled(robot(), "ekf"), "sigma_range_m": 0.1}),
            'kind, sigma_range_m: these look like settings of one estimator; give them a label: {"mine"',
        ),
        (lambda runs: fl.replay(runs, [print]), "expected an estimator, got builtin_function_or_method"),
        (lambda runs: fl.replay(runs, ["ekf", {"ekf": {}}]), "estimator ekf is given twice"),
        (lambda runs: fl.replay(runs, []), "no estimators to replay"),
        (lambda _: fl.replay([], "ekf"), "no logs to replay"),
        (lambda _: fl.replay([3], "ekf"), "cannot replay a int"),
        (lambda runs: fl.replay(runs, "ekf", metrics="acuracy"), "did you mean 'accuracy'"),
        (lambda runs: fl.replay(runs, "ekf", gap_limit_s=-1.0), "gap_limit_s is -1.0"),
        (lambda runs: fl.replay(runs, "ekf", start_s=float("nan")), "start_s is nan"),
        (
            lambda runs: fl.replay(runs, "ekf", start_s=9.0),
            "no messages in this span; the log extends from 0 to 4 s",
        ),
        (lambda runs: fl.replay(runs, "ekf", start_s=1.0), "--start-from truth"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    call: Callable[[Any], object], words: str, recordings: list[fl.MemorySource]
) -> None:
    with pytest.raises(fl.BadInput) as raised:
        call(recordings)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)
    assert list(Path().iterdir()) == []


@pytest.mark.paper
def test_estimates_are_kept_as_long_as_the_replay(
    recordings: list[fl.MemorySource], caplog: pytest.LogCaptureFixture, collect: Callable[[], int]
) -> None:
    """Two at once do not disturb each other, and neither leaves anything behind."""
    first, second = (fl.replay(recordings[0], "ekf") for _ in range(2))
    places = [done.estimates[0].log.path for done in (first, second)]
    estimates = second.estimates[0]
    del first
    collect()
    assert [place.parent.exists() for place in places] == [False, True]
    del second
    collect()
    assert len(estimates[POSE])
    del estimates
    collect()
    assert not places[1].parent.parent.exists()
    assert caplog.records == []


@pytest.mark.usefixtures("blank_figures")
def test_an_experiment_is_run_as_the_command_runs_it(fuselog: Fuselog) -> None:
    done = fl.run("landmarks", runs=2, seed=4, set={"duration_s": 3.0, "ekf": {"gate_probability": 0.9}})
    assert done.folder == Path("out/landmarks")
    options = "--runs 2 --seed 4 --set duration_s=3.0 --set ekf.gate_probability=0.9 --out there"
    assert fuselog("run", "landmarks", *options.split()).code == 0
    there = read_result(Path("there"))
    assert done.result.metrics == there.metrics
    assert (
        dict(zip(done.metrics.columns, done.metrics.iloc[0], strict=True))["estimator"]
        == "dead-reckoning"
    )
    assert (len(done.tables["runs"]), len(done.claims)) == (6, 0)


def test_the_timeline_in_a_notebook(
    monkeypatch: pytest.MonkeyPatch, recordings: list[fl.MemorySource]
) -> None:
    """Its cell gets the timeline, or the sentence that says what to install."""
    shown: list[Any] = []

    class Viewer:
        def __init__(self, **size: str) -> None:
            self.size = size

        def send_rrd(self, data: bytes) -> None:
            Path("shown.rrd").write_bytes(data)

    ipython, display, widgets = (
        ModuleType(name) for name in ("IPython", "IPython.display", "rerun_notebook")
    )
    vars(ipython)["get_ipython"] = lambda: SimpleNamespace(kernel="a kernel")
    vars(display)["display"] = shown.append
    vars(widgets)["Viewer"] = Viewer
    for module in (ipython, display):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    done = fl.replay(recordings, "ekf")
    monkeypatch.setitem(sys.modules, "rerun_notebook", None)
    with pytest.raises(fl.BadInput, match=r"pip install rerun-notebook==0\.\d+"):
        done.view()
    monkeypatch.setitem(sys.modules, "rerun_notebook", widgets)
    done.view(run=1)
    assert [type(each) for each in shown] == [Viewer]
    assert len(RrdReader("shown.rrd").recordings()) == 1
    with pytest.raises(fl.BadInput, match="no run 2 to show; the runs are 0 to 1"):
        done.view(run=2)


def test_a_figure_shows_a_case() -> None:
    done = fl.replay(fl.record("landmarks", robots=2, **SHORT), "ekf")
    assert done.figure("robot2").get_suptitle().startswith("robot2, 1 run")
    assert done.figure().get_suptitle().startswith("robot1, 1 run")
    with pytest.raises(fl.BadInput, match="no case 'robot3' was judged"):
        done.figure("robot3")


def test_replays_results_and_entries_are_short_and_tables_in_a_notebook(world: Path) -> None:
    """Of several cases the medians; what a folder's name may hold is no HTML."""
    logs = [fl.record("landmarks", seed=seed, robots=9, **SHORT) for seed in (1, 2)]
    done = fl.replay(logs, {"ekf": {"sigma_range_m": 0.01}, "ukf": {}})
    saved = ResultFolder(Path("<i>result"), read_result(world / "result"))
    for shown in (done, saved):
        text, page = repr(shown), shown._repr_html_()
        assert len(text.splitlines()) < 25
        for nees in shown.metrics.pivot_table("value", "quantity", "estimator", "median").loc["nees"]:
            assert f" {nees:.4g} (" in text
            assert f"<td>{nees:.4g} (" in page
    assert done.alarms[0].sentence in repr(done)
    assert "<i>" not in saved._repr_html_()
    robot = fl.models["robot"]
    assert repr(robot) == f"robot: {robot.what}"
    assert "<td>sigma_range_m</td><td>from the log</td><td>m</td>" in robot._repr_html_()
    assert f"<td>robot</td><td>{robot.what}</td>" in fl.models._repr_html_()


def test_lists_are_mappings_of_names() -> None:
    assert "landmarks" in fl.scenarios
    assert fl.models["robot"].what in repr(fl.models)
    assert "accuracy" in fl.metrics
    assert fl.experiments.get("no-such") is None
    assert fl.experiments["landmarks"].facts["study"] == "localization"
