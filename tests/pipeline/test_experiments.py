"""Experiments: the result folder and its result.json, the same every time; the report page."""

import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from fuselog.pipeline.output.charts import Chart
from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.results import TIMINGS, Outcome, result_folder, write_outcome
from fuselog.pipeline.output.summary import summarise
from fuselog.pipeline.output.words import Scale, alike
from fuselog.pipeline.runs.estimates import hash_files, hash_streams
from fuselog.pipeline.runs.experiment import (
    Experiment,
    Setting,
    Study,
    experiment_of_logs,
    load_experiment,
    run_experiment,
)
from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, open_log, schemas
from fuselog.recorders.parameters import build
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.judge import Judge
from tests.conftest import without_drawing

pytestmark = pytest.mark.paper

Fuselog = Callable[..., Any]
SHORT = ["--set", "duration_s=2"]
RUN = ["run", "landmarks", "--set", "duration_s=2", "--runs", "3", "--seed", "5"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, fuselog: Fuselog) -> Path:
    """A small result."""
    folder = tmp_path_factory.mktemp("results") / "first"
    assert fuselog(*RUN, "--logs", "2", "--out", str(folder)).code == 0
    return folder


def _contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        # by the clock: Rerun's chunks, and what estimators cost
        if path.is_file() and path.suffix != ".rrd" and path.name != TIMINGS
    }


def test_a_result_folder_holds_what_it_promises(result: Path) -> None:
    names = set(_contents(result))
    assert {f"logs/run-000{run}.mcap" for run in range(2)} <= names
    assert "logs/run-0002.mcap" not in names
    assert {f"estimates/run-000{run}.mcap" for run in range(2)} <= names
    tables = {f"tables/{name}.parquet" for name in ("summary", "steps", "runs", "times")}
    assert tables | {"figures/errors-robot1.svg"} <= names
    assert not any(name.startswith("tables/errors") for name in names)  # which --errors asks for
    assert (result / "timeline.rrd").is_file()
    pd.testing.assert_frame_equal(
        pd.read_csv(result / "tables/steps.csv"), pd.read_parquet(result / "tables/steps.parquet")
    )


def test_what_estimators_cost_is_kept_beside_the_result(result: Path) -> None:
    """Each was given the messages of its topics; the file has no hash, for it is by the clock."""
    kept = json.loads((result / TIMINGS).read_text())
    coverage = pd.read_parquet(result / "tables/coverage.parquet").groupby("estimator")["messages"].sum()
    assert list(kept) == ["dead-reckoning", "ekf", "ukf"]
    assert kept["ekf"]["messages"] >= coverage["ekf"] > kept["dead-reckoning"]["messages"] > 0
    assert all(0.0 < each["seconds"] < 60.0 for each in kept.values())
    assert json.loads((result / "result.json").read_text())["files"][TIMINGS] is None


@without_drawing()
def test_every_error_is_kept_where_that_is_asked_for(tmp_path: Path, fuselog: Fuselog) -> None:
    """A file per estimator and case; the sums of the other tables are made of the same errors."""
    assert fuselog(*RUN, "--errors", "--logs", "1", "--out", str(tmp_path / "all")).code == 0
    folder = tmp_path / "all" / "tables"
    files = sorted(path.stem for path in (folder / "errors").iterdir())
    assert files == ["dead-reckoning-robot1", "ekf-robot1", "ukf-robot1"]
    errors = pd.read_parquet(folder / "errors" / "ekf-robot1.parquet")
    runs = pd.read_parquet(folder / "runs.parquet").query("estimator == 'ekf'")
    squared = errors["error_x_m"] ** 2 + errors["error_y_m"] ** 2
    rmse = np.sqrt(squared.groupby(errors["run"]).mean())
    np.testing.assert_allclose(rmse, runs["position_rmse_m"], rtol=1e-12)
    judged = ["evaluate", str(tmp_path / "all/estimates/run-0000.mcap"), "--errors"]
    assert fuselog(*judged, "--out", str(tmp_path / "again")).code == 0
    again = pd.read_parquet(tmp_path / "again/tables/errors/ekf-robot1.parquet")
    pd.testing.assert_frame_equal(again, errors[errors["run"] == 0].reset_index(drop=True))
    said = fuselog(*judged)
    assert (said.code, "--errors: individual errors are written into a" in said.err) == (
        2,
        True,
    )


def test_result_json_has_its_shape_and_no_nan(result: Path) -> None:
    text = (result / "result.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    values = json.loads(text)
    assert list(values) == [
        *["format", "experiment", "fuselog", "settings", "input_sha256", "metrics", "claims", "files"],
        *["bounds", "intervals", "alarms", "causes", "kind"],
    ]
    assert set(values["files"]) == {*_contents(result), "timeline.rrd", TIMINGS}
    assert (values["experiment"], values["kind"]) == ("landmarks", "run")
    assert values["settings"]["seed"] == 5
    assert values["settings"]["record"]["parameters"] == {"duration_s": 2}
    assert re.fullmatch("[0-9a-f]{64}", values["input_sha256"])
    assert values["claims"] == []
    for key, value in values["metrics"].items():
        estimator, quantity, case = key.split(".")
        assert estimator in {"dead-reckoning", "ekf", "ukf"}
        assert re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", quantity)
        assert case == "robot1"
        assert isinstance(value, float)


def test_a_run_twice_gives_the_same_bytes(result: Path, fuselog: Fuselog) -> None:
    """Also with the process's folder, the place of the result and the number of logs changed."""
    second = result.with_name("second")
    with chdir(result.parent):
        assert fuselog(*RUN, "--logs", "3", "--out", "second").code == 0
    first, again = _contents(result), _contents(second)
    said, said_again = (json.loads(each.pop("result.json")) for each in (first, again))
    assert said.pop("files").items() - said_again.pop("files").items() == {_own_entry(result)}
    assert said == said_again
    assert {name: again[name] for name in first} == first
    assert len(again) == len(first) + 2


def _own_entry(result: Path) -> tuple[str, str]:
    """What result.json says of itself: of another list of files, another number."""
    return "result.json", json.loads((result / "result.json").read_text())["files"]["result.json"]


def test_the_first_runs_log_is_recorded_again_from_the_seed(result: Path, fuselog: Fuselog) -> None:
    """Logs that were not written can be had: run 1 of seed 5 is run 1 of seed 5."""
    again = result.with_name("again.mcap")
    where = ["--set", "duration_s=2", "--seed", "5", "--run", "1", "--out", str(again)]
    assert fuselog("record", "landmarks", *where).code == 0
    assert again.read_bytes() == (result / "logs/run-0001.mcap").read_bytes()


@without_drawing()
def test_the_logs_of_a_result_replay_and_judge_as_the_result(result: Path, fuselog: Fuselog) -> None:
    """`evaluate` on the folder's estimates finds their logs, and says what result.json says."""
    estimates = sorted(map(str, (result / "estimates").iterdir()))
    values = fuselog("evaluate", *estimates, "--json").json["metrics"]
    whole = result.with_name("whole")
    assert fuselog(*RUN[:-4], "--runs", "2", "--seed", "5", "--out", str(whole)).code == 0
    expected = json.loads((whole / "result.json").read_text())["metrics"]
    assert values == pytest.approx(expected, rel=1e-12)


def test_the_report_is_one_page_with_all_numbers(result: Path, tmp_path: Path, fuselog: Fuselog) -> None:
    page = tmp_path / "page.html"
    assert fuselog("report", str(result), str(result), "--out", str(page)).code == 0
    text = page.read_text()
    assert text.count('class="plot"') == 6  # of each the first run, errors, NIS; see test_report
    assert text.count("position_rmse_m") >= 2
    assert "seed 5" in text


def test_claims_lists_and_odd_text_reach_the_json_the_page_and_the_terminal(
    tmp_path: Path, fuselog: Fuselog
) -> None:
    """NaN becomes null, lists stay lists, and what looks like HTML stays text."""
    figure = matplotlib.figure.Figure()
    figure.subplots().plot([0, 1])
    claims = [
        Claim("A beats B <always>", "yes", "no", "refuted", "3 of 10 runs"),
        Claim("C is 4", "4.0", "4.01", "confirmed"),
    ]
    outcome = Outcome(
        {"a.error_m": float("nan"), "a.curve_m.case": [1.0, None, float("inf")]},
        claims,
        {"short": pd.DataFrame({"name": ["x"], "value": [0.25]})},
        {"line": figure},
        "0" * 64,
    )
    with result_folder(tmp_path / "result") as part:
        write_outcome(part, "test", {"title": "A & B"}, outcome)
    values = json.loads((tmp_path / "result/result.json").read_text())
    assert values["metrics"] == {"a.error_m": None, "a.curve_m.case": [1.0, None, None]}
    assert values["claims"][1] == {
        "claim": "C is 4",
        "paper": "4.0",
        "ours": "4.01",
        "verdict": "confirmed",
        "why": "",
    }
    page = tmp_path / "page.html"
    assert fuselog("report", str(tmp_path / "result"), "--out", str(page)).code == 0
    text = page.read_text()
    assert "A beats B &lt;always&gt;" in text
    assert "A &amp; B" in text
    assert all(claim.ours in text and claim.verdict in text for claim in claims)


def test_a_result_replaces_a_result_only_when_it_is_whole(tmp_path: Path) -> None:
    """An experiment that fails leaves the earlier result as it was."""
    with result_folder(tmp_path / "new" / "r") as part:
        write_outcome(part, "first", {"title": ""}, Outcome())
    before = _contents(tmp_path / "new" / "r")
    for place in ("new", "other"):
        with pytest.raises(ZeroDivisionError):
            _fail_half_way(tmp_path / place / "r")
    assert _contents(tmp_path / "new" / "r") == before
    assert [path.name for path in tmp_path.rglob("*.part")] == []
    assert not (tmp_path / "other").exists()


def _fail_half_way(folder: Path) -> None:
    with result_folder(folder) as part:
        (part / "half").touch()
        raise ZeroDivisionError


def test_no_two_topics_share_a_figure_and_none_runs_in_the_page(
    tmp_path: Path, fuselog: Fuselog
) -> None:
    """What is in an SVG file, and what a topic is called, stays an image and a name."""
    names = ["a/b", "a-b", "a%2Fb", "../a", "\0$\\frac"]
    outcome = Outcome(figures={name: matplotlib.figure.Figure(figsize=(1, 1)) for name in names})
    with result_folder(tmp_path / "r") as part:
        write_outcome(part, "test", {"title": ""}, outcome)
    files = list((tmp_path / "r/figures").iterdir())
    assert len(files) == len(names)
    files[0].write_text('<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)"><script/></svg>')
    assert fuselog("report", str(tmp_path / "r"), "-o", str(tmp_path / "page.html")).code == 0
    text = (tmp_path / "page.html").read_text()
    assert text.count("<img src=") == len(names)
    assert 'onload="alert' not in text
    assert "<script/>" not in text


def test_stated_ticks_are_drawn_as_they_are(tmp_path: Path) -> None:
    """A name at a tick is no formula; the numbers of a logarithmic axis are."""
    figure = matplotlib.figure.Figure()
    axes = figure.subplots()
    axes.boxplot([[1, 20], [3, 40]], tick_labels=["$\\foo$", "a$b$"])
    axes.set_yscale("log")
    with result_folder(tmp_path / "r") as part:
        write_outcome(part, "test", {"title": ""}, Outcome(figures={"f": figure}))
    drawn = (tmp_path / "r" / "figures" / "f.svg").read_text()
    for text in ("$\\foo$", "a$b$", "$\\mathdefault{10^{1}}$"):
        assert f"<!-- {text} -->" in drawn
    names = [label for label in axes.get_xticklabels() if not label.get_parse_math()]
    assert len(names) == 2


def test_topics_that_look_like_formulas_are_drawn(tmp_path: Path) -> None:
    """A dollar sign starts no formula, and two cases that differ by a sign have two figures."""
    time_ns = np.arange(3)
    state = {"state": np.zeros((3, 2))}
    pose = {"components": "x_m,y_m", "kinds": "linear,linear"}
    cases = ["a$\\foo$/b", "a$\\foo$-b"]
    truths = [
        make_stream(f"/{case}/truth", schemas.TRUTH_STATE, time_ns, metadata=pose, **state)
        for case in cases
    ]
    estimates = [
        make_stream(
            f"/estimates/e/{case}/pose",
            schemas.GAUSSIAN_ESTIMATE,
            time_ns,
            metadata={**pose, "truth": f"/{case}/truth"},
            mean=np.zeros((3, 2)),
            covariance=np.tile(np.eye(2).ravel(), (3, 1)),
        )
        for case in cases
    ]
    source = memory_source(Recording(truths), RunMetadata("test", epoch_ns=0))
    outputs = {stream.topic: gather([stream]) for stream in estimates}
    judge = Judge([source], gap_limit_s=1.0)
    judge.add(outputs)
    outcome = summarise(judge)
    with result_folder(tmp_path / "r") as part:
        write_outcome(part, "test", {"title": ""}, outcome)
    assert len(list((tmp_path / "r/figures").glob("*.svg"))) == 2


@without_drawing()
def test_probabilities_of_modes_are_drawn_beside_the_errors(tmp_path: Path, fuselog: Fuselog) -> None:
    """Of the interacting filter alone, over time, and dashed in the same colour given all data."""
    folder = tmp_path / "result"
    run = ["run", "manoeuvres", "--runs", "2", "--set", "duration_s=10", "--out", folder]
    assert fuselog(*run).code == 0
    chart = build(Chart, json.loads((folder / "figures/modes-vehicle1.json").read_text()), "chart")
    [panel] = chart.panels
    assert panel.title == "imm:ekf"
    for style in ("line", "dashed"):
        series = [each for each in panel.series if each.style == style]
        assert [each.label for each in series] == ["drive", "manoeuvre", "stand"]
        probabilities = np.array([each.y for each in series])
        assert probabilities.shape == (3, 20)  # two fixes a second
        assert probabilities.min() > 0.0
        assert_allclose(probabilities.sum(axis=0), 1.0, atol=1e-6)
    table = pd.read_parquet(folder / "tables/modes.parquet")
    assert_allclose(table.groupby(["smoothed", "elapsed_s"])["probability"].sum(), 1.0, rtol=1e-12)
    assert fuselog("report", folder, "-o", tmp_path / "page.html").code == 0
    assert "probability of each mode" in (tmp_path / "page.html").read_text()


@without_drawing()
def test_real_data_run_as_an_experiment(world: Path, tmp_path: Path, fuselog: Fuselog) -> None:
    """The MRCLAM layout goes in at --data; unknown barcodes are told."""
    data = str(world / "mrclam")
    said = fuselog(
        "run", "mrclam", "--data", data, "--set", "sigma_range_m=0.3", "--out", str(tmp_path / "r")
    )
    assert said.code == 0, said.err
    values = json.loads((tmp_path / "r/result.json").read_text())
    assert values["settings"]["data"] == data
    assert values["metrics"]["ekf.failed_runs.robot1"] == 0
    log = open_log(tmp_path / "r/logs/run-0000.mcap")
    assert log.run is not None
    assert log.run.parameters["sigma_range_m"] == 0.3
    assert "99" in " ".join(log.run.notes)


def test_a_run_that_fails_is_told_and_the_others_go_on(
    world: Path, tmp_path: Path, fuselog: Fuselog
) -> None:
    """A filter told of tiny noise and far too large steps loses its covariance, not the ensemble."""
    said = fuselog(
        *["replay", str(world / "log.mcap"), "-e", "ukf", "-e", "lost", "--set", "lost.kind=ukf"],
        *["--set", "lost.turn_noise_density=1e160", "--out", str(tmp_path), "--json"],
    )
    assert said.code == 1, said.err
    assert said.json["metrics"]["ukf.failed_runs.robot1"] == 0
    assert said.json["metrics"]["lost.failed_runs.robot1"] == 1
    (sentence,) = said.json["failures"]
    assert "lost robot1 failed at" in sentence
    assert sentence in said.err


def test_recording_on_an_executor_gives_the_same_runs() -> None:
    with ThreadPoolExecutor(2) as executor:
        there = record_ensemble("landmarks", {"duration_s": 1.0}, 3, 4, executor=executor)
    here = record_ensemble("landmarks", {"duration_s": 1.0}, 3, 4)
    assert hash_streams(there) == hash_streams(here)
    first, second = (source.streams["/robot1/truth"]["state"] for source in here[:2])
    assert not np.array_equal(first, second)


def test_the_hash_of_the_data_is_of_all_of_them(tmp_path: Path) -> None:
    """Another stamp, number or run, or another file: another hash. The same: the same."""
    [source] = record_ensemble("landmarks", {"duration_s": 1.0}, 3, 1)
    stream = source.streams["/robot1/odometry"]
    later = stream.publish_time_ns + np.arange(len(stream)) // (len(stream) - 1)
    changed = {
        "publish time": replace(stream, publish_time_ns=later),
        "log time": replace(stream, log_time_ns=later),
        "column": replace(
            stream, columns={**stream.columns, "turn_radps": stream["turn_radps"] + 1e-15}
        ),
    }
    sources = [
        replace(source, streams={**source.streams, stream.topic: each}) for each in changed.values()
    ]
    hashes = [hash_streams([each]) for each in (*sources, source)]
    hashes += [hash_streams([source, source]), hash_streams(record_ensemble("landmarks", {}, 3, 1))]
    paths = [tmp_path / name for name in "ab"]
    for path in paths:
        path.write_bytes(path.name.encode())
    hashes += [hash_files(each) for each in ([paths[0]], [paths[1]], paths, paths[::-1])]
    assert len(set(hashes)) == len(hashes)
    assert hash_streams([source]) == hash_streams(
        record_ensemble("landmarks", {"duration_s": 1.0}, 3, 1)
    )


def test_a_study_that_fails_is_one_sentence_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Studies are registered code like recorders and estimators: theirs are no tracebacks either."""

    def divide(_: Experiment, setting: Setting) -> Outcome:
        (setting.folder / "half").write_text("written")
        raise ZeroDivisionError("no runs")

    monkeypatch.setattr("fuselog.pipeline.runs.experiment.load", lambda *_: Study("fails", divide))
    with pytest.raises(BadInput, match="study mine raised ZeroDivisionError: no runs"):
        run_experiment("x", Experiment(title="x", study="mine"), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.paper
@without_drawing()
def test_nothing_is_refuted_by_estimates_that_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All runs fail: comparisons with NaN are false, which must not read as a refutation."""
    monkeypatch.setattr("fuselog.recorders.log.impossible.limit_of", lambda _: 1e300)
    label, experiment = load_experiment("reactor", {"prior_variance": 1e200}, {"runs": 2})
    result = run_experiment(label, experiment, tmp_path / "out", logs=1)
    assert {claim.verdict for claim in result.claims} == {"not reproducible"}
    assert all(claim.why.endswith("estimates are missing") for claim in result.claims)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory, fuselog: Fuselog) -> Path:
    """Two logs with the estimates of one beside them, and an experiment's file."""
    folder = tmp_path_factory.mktemp("drives")
    for seed in (1, 2):
        log = str(folder / f"drive-{seed}.mcap")
        assert fuselog("record", "landmarks", "--seed", str(seed), *SHORT, "-o", log).code == 0
    assert fuselog("replay", str(folder / "drive-1.mcap"), "-e", "ekf").code == 0
    text = 'title = "Two drives"\n[logs]\nfiles = ["drive-*.mcap"]\n[estimators.ekf]\n[estimators.ukf]\n'
    (folder / "drives.toml").write_text(text)
    return folder


@without_drawing()
def test_logs_are_replayed_as_an_experiment(drives: Path, tmp_path: Path, fuselog: Fuselog) -> None:
    """By a file that names them, by --data, by their names: the same numbers as replayed and judged."""
    logs = [str(drives / f"drive-{seed}.mcap") for seed in (1, 2)]
    ways = [
        [str(drives / "drives.toml")],
        [str(drives / "drives.toml"), "--data", str(drives)],
        [*logs, "-e", "ekf", "-e", "ukf"],
    ]
    found = [
        fuselog("run", *way, "--json", "--out", str(tmp_path / str(number))).json
        for number, way in enumerate(ways)
    ]
    judged = fuselog("replay", *logs, "-e", "ekf", "-e", "ukf", "--json", "--out", str(tmp_path)).json
    for each in found:
        assert each["metrics"] == judged["metrics"]
        assert each["input_sha256"] == found[0]["input_sha256"]
        assert each["settings"]["logs"]["files"] == logs
        assert each["settings"]["parameters"]["ukf"]["gate_probability"] == 0.999
    names = set(_contents(tmp_path / "0"))
    assert {f"estimates/run-000{run}.mcap" for run in range(2)} <= names
    assert not any(name.startswith("logs/") for name in names)
    assert fuselog("evaluate", str(tmp_path / "0/estimates/run-0001.mcap")).code == 0
    assert fuselog("report", str(tmp_path / "0"), "-o", str(tmp_path / "page.html")).code == 0


def test_a_bare_name_sets_a_parameter_of_all_estimators_that_have_it() -> None:
    """What is set for one of them counts more, in any order; the scenario's parameters come first."""
    stated = experiment_of_logs([Path(__file__)], ["ekf", "ukf", "dead-reckoning"])
    settings = {"ukf": {"sigma_range_m": 0.2}, "sigma_range_m": 0.3}
    for given in (settings, dict(reversed(settings.items()))):
        experiment = stated.with_settings(given, {})
        assert experiment.estimators == {
            "ekf": {"sigma_range_m": 0.3},
            "ukf": {"sigma_range_m": 0.2},
            "dead-reckoning": {},
        }
    _, landmarks = load_experiment("landmarks", {"forward_noise_density": 0.1, "sigma_range_m": 1}, {})
    assert landmarks.record is not None
    assert landmarks.record.parameters["forward_noise_density"] == 0.1
    assert landmarks.estimators["ekf"] == {"gate_probability": 1.0, "sigma_range_m": 1}
    with pytest.raises(
        BadInput, match=r"--set gate_probabilty: not an entry of the experiment.*'gate_probability'"
    ):
        load_experiment("landmarks", {"gate_probabilty": 1}, {})


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["drive-1.mcap"], "name the estimators to replay, such as -e ekf"),
        (["drive-1.mcap", "landmarks", "-e", "ekf"], "give only logs and -e"),
        (["drive-1.mcap", "-e", "ekf", "--runs", "3"], "give only logs and -e"),
        (["drive-9.mcap", "-e", "ekf"], "no log matches drive-9.mcap"),
        (["landmarks", "-e", "ekf"], "give one experiment at a time"),
        (["drives.toml", "--data", "nowhere"], "no log matches nowhere"),
        (["drives.toml", "--runs", "3"], "a fixed number of runs"),
        (["drive-1.mcap", "-e", "ekf", "--set", "ekf.gate=1"], "no parameter 'gate'"),
    ],
)
def test_bad_input_to_a_run_of_logs_is_one_sentence(
    arguments: list[str],
    sentence: str,
    drives: Path,
    fuselog: Fuselog,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(drives)
    before = sorted(drives.iterdir())
    said = fuselog("run", *arguments, "--out", "out")
    assert said.code == 2
    assert sentence in said.err
    assert sorted(drives.iterdir()) == before


@without_drawing()
def test_the_mean_nees_over_runs_has_its_interval_and_what_was_written_is_listed(
    fuselog: Fuselog, tmp_path: Path
) -> None:
    """By hand: 2.776 standard errors to either side, Student's quantile of five runs."""
    out = tmp_path / "five"
    run = ("run", "landmarks", "--set", "duration_s=2", "--logs", "0", "--out", out)
    printed = fuselog(*run, "--runs", "5").out
    found = pd.read_parquet(out / "tables" / "runs.parquet").groupby("estimator")["nees"]
    for mean, error in zip(found.mean(), found.sem(), strict=True):
        low, high = mean - 2.7764 * error, mean + 2.7764 * error
        expected = f"{mean:.3g} (95 % {low:.3g} to {high:.3g}), aim 3"
        assert expected in printed
    fuselog("report", out, "-o", tmp_path / "five.html")
    of_page = alike([mean, low, high], Scale())
    expected = f"NEES {of_page[0]} (95 % {of_page[1]} to {of_page[2]}); 3 is ideal"
    assert expected in (tmp_path / "five.html").read_text(encoding="utf-8")
    assert printed.splitlines()[-3] == f"{out}: figures, tables, timeline.rrd, {TIMINGS}, result.json"
    names = {"figures", "tables", "timeline.rrd", TIMINGS, "result.json"}
    assert {path.name for path in out.iterdir()} == names
    four = fuselog(*run, "--runs", "4").out
    assert "nees_mean_over_runs" not in four
    assert "nees: its mean over the runs has no interval: an interval needs at least 5 runs" in four
    fuselog("report", out, "-o", tmp_path / "four.html")
    page = (tmp_path / "four.html").read_text(encoding="utf-8")
    assert "No 95 % intervals: an interval needs at least 5 runs, and there are only 4." in page


def test_a_parameter_goes_to_all_estimators_that_have_it() -> None:
    """What is set for one of them counts more."""
    settings = {"bias_range_m": 0.5, "ekf": {"bias_range_m": 0.25}, "kappa": 1.0}
    _, found = load_experiment("landmarks", settings, {})
    set_to = {label: values.get("bias_range_m") for label, values in found.estimators.items()}
    assert set_to == {"dead-reckoning": None, "ekf": 0.25, "ukf": 0.5}
    assert [label for label, values in found.estimators.items() if "kappa" in values] == ["ukf"]
    _, found = load_experiment("landmarks", {"turn_bias_radps": 0.1, "turn_scale": 0.9}, {})
    assert [values.get("turn_scale") for values in found.estimators.values()] == [0.9] * 3
