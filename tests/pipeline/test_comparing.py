"""Comparing: what two candidates are made of, what is said of them, what is refused."""

import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rerun.blueprint as rrb
import tomli_w

import fuselog as fl
from fuselog.pipeline.comparing.candidates import _stored
from fuselog.pipeline.comparing.comparing import ALL, Differences, Paired, under_stress
from fuselog.pipeline.comparing.groups import unlike_runs
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.output.alarms import Stressing
from fuselog.replay.judging.errors.differences import Difference
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.timeline.side_by_side import _alone

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
RUNS = 6
TIGHT = {"kind": "ekf", "sigma_range_m": 0.05, "sigma_bearing_rad": 0.01}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Short runs of one seed."""
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / f"run-{run}.mcap" for run in range(RUNS)]
    for run, path in enumerate(paths):
        fl.write(path, fl.record("landmarks", seed=2, run=run, duration_s=8.0))
    return paths


@pytest.fixture(scope="module")
def estimates(logs: list[Path], fuselog: Fuselog) -> Path:
    """The estimates logs of all runs."""
    folder = logs[0].parent / "estimates"
    said = fuselog(
        "replay", *logs, "-e", "ekf", "-e", "ukf", "--set", "gate_probability=1", "--out", folder
    )
    assert said.code == 0, said.err
    return folder


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder of the same runs' scenario."""
    folder = tmp_path_factory.mktemp("results") / "landmarks"
    fl.run("landmarks", runs=RUNS, seed=2, out=folder, logs=1, set={"duration_s": 8.0})
    return folder


@pytest.mark.paper
def test_noise_taken_for_too_small_is_worse_in_nees(logs: list[Path], tmp_path: Path) -> None:
    found = fl.compare(*logs, estimators=["ekf", {"tight": TIGHT}])
    row = found.table.query("quantity == 'nees'").iloc[0]
    assert (row["verdict"], row["runs"], row["aim"]) == ("worse", RUNS, "3")
    assert 0 < row["low"] < row["difference"] < row["high"]
    # what is compared are the metrics of every run
    own = [fl.replay(log, [{"tight": TIGHT}], metrics="consistency").metrics for log in logs[:2]]
    nees = [each.query("quantity == 'nees'")["value"].item() for each in own]
    judged = found.groups[0][1].rows.query("quantity == 'nees'")["value"].tolist()
    assert judged[:2] == nees
    assert row["second_mean"] == pytest.approx(np.mean(judged))
    saved = found.save(tmp_path / "out")
    assert (saved.folder / "timeline.rrd").stat().st_size > 10_000
    assert saved.metrics.query("quantity == 'nees_difference'")["value"].item() == row["difference"]
    times = saved.tables["times"].query("quantity == 'nees'")
    assert (times["low"] > 0).mean() > 0.5
    assert any("sigma_range_m" in note for note in found.notes)
    assert "nees" in {each.quantity for each in found.worse()}
    with pytest.raises(
        fl.BadInput, match=r"out: its runs have names, so it is the result of a comparison"
    ):
        fl.compare(tmp_path / "out", tmp_path / "out")


@pytest.mark.paper
def test_a_worse_candidate_fails_a_build(logs: list[Path], fuselog: Fuselog, tmp_path: Path) -> None:
    """A folder of logs is replayed; of too few runs nothing can be said, which is no success either."""
    settings = tmp_path / "settings.toml"
    settings.write_text(tomli_w.dumps({"ekf": {}, "tight": TIGHT}), encoding="utf-8")
    build = ("--fail-if-worse", "--settings", settings)
    for first, second, code in (("ekf", "tight", 1), ("tight", "ekf", 0)):
        said = fuselog("compare", logs[0].parent, "-e", first, "-e", second, *build)
        assert (said.code, "worse than the first: tight in" in said.err) == (code, code == 1)
    said = fuselog("compare", *logs[:4], "-e", "ekf", "-e", "tight", *build)
    assert said.code == 2
    assert "an interval needs at least 5 runs, and the comparison has only 4 runs" in said.err


def test_a_candidate_that_cannot_be_judged_is_no_success(logs: list[Path]) -> None:
    """It lacks what the first is judged by, and nothing else shows that it is worse."""
    found = fl.compare(*logs, estimators=["ekf", "ukf"])
    [[first, second]] = found.groups
    assert not found.worse()
    mute = replace(second, rows=second.rows[second.rows["quantity"] != "nees"])
    with pytest.raises(fl.BadInput, match=r"ukf: has no nees, which ekf has, so it cannot be judged"):
        replace(found, groups=[[first, mute]]).worse()
    assert not replace(found, groups=[[mute, first]]).worse()


def test_a_folder_with_something_else_among_its_logs_is_named(
    logs: list[Path], fuselog: Fuselog, tmp_path: Path
) -> None:
    shutil.copy(logs[0], tmp_path / "run.mcap")
    (tmp_path / "broken.mcap").write_text("no log")
    said = fuselog("compare", tmp_path, "-e", "ekf", "-e", "ukf")
    assert said.code == 2
    assert "broken.mcap" in said.err


@pytest.mark.paper
def test_a_result_gives_what_its_estimates_logs_and_a_replay_give(
    result: Path, estimates: Path, logs: list[Path]
) -> None:
    """Three ways to one comparison."""
    ways = [
        fl.compare(result, estimators=["ekf", "ukf"]),
        fl.compare(estimates, estimators=["ekf", "ukf"]),
        fl.compare(*logs, estimators=[{label: {"gate_probability": 1.0}} for label in ("ekf", "ukf")]),
    ]
    tables = [way.table.drop(columns=["most_from_s", "most_to_s"]) for way in ways]
    for table in tables[1:]:
        assert table["quantity"].tolist() == tables[0]["quantity"].tolist()
        numbers = [each.select_dtypes("number").to_numpy() for each in (table, tables[0])]
        np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-12)
    assert "worse" not in tables[0]["verdict"].tolist()


@pytest.mark.paper
def test_a_result_that_a_replay_no_longer_gives_is_compared_as_it_is(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one from before a change of the code: its own rows count, not those of today."""
    import fuselog.pipeline.comparing.candidates as candidates

    def changed(*logs: Any, **options: Any) -> Any:
        wrong = [{label: {"sigma_range_m": 0.2} if label == "ekf" else {}} for label in logs[1][0]]
        return fl.replay(logs[0], wrong, **options)

    kept = fl.compare(result, result, estimators=["ekf"])
    assert set(kept.table["verdict"]) == {"tie"}
    names = [candidate.name for candidate in kept.groups[0]]
    assert [row.estimator for row in kept.coverage] == names
    assert "ekf" not in names
    monkeypatch.setattr(candidates, "replay", changed)
    found = fl.compare(result, estimators=["dead-reckoning", "ekf"])
    [note] = [each for each in found.notes if "in a new replay" in each]
    assert "of ekf" in note
    rows = found.groups[0][1].rows
    stored = pd.read_parquet(result / "tables" / "runs.parquet").query("estimator == 'ekf'")
    nees = rows.query("quantity == 'nees'")["value"].tolist()
    assert nees == stored["nees"].tolist()
    assert found.groups[0][1].sizes == {("nees", "robot1"): 3.0}


def test_a_result_of_logs_is_replayed_from_them(
    logs: list[Path], fuselog: Fuselog, tmp_path: Path
) -> None:
    assert fuselog("run", *logs[:2], "-e", "ekf", "-e", "ukf", "--out", tmp_path / "own").code == 0
    found = fl.compare(tmp_path / "own")
    assert "log_likelihood" in set(found.table["quantity"])
    assert set(found.table["runs"]) == {2}
    assert not [note for note in found.notes if "stored in the result" in note]


def test_a_trajectory_is_compared_like_estimates(
    estimates: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """As somebody else's tool wrote it: the same errors, without NEES."""
    log = estimates / "run-0.estimates.mcap"
    assert fuselog("export", log, "--to", "tum", "--out", tmp_path / "tum").code == 0
    [file] = (tmp_path / "tum").glob("*ukf*")
    found = fl.compare(log, file, estimators=["ekf"])
    row = found.table.query("quantity == 'position_rmse_m'").iloc[0]
    own = fl.compare(log, estimators=["ekf", "ukf"]).table.query("quantity == 'position_rmse_m'").iloc[0]
    assert row["difference"] == pytest.approx(own["difference"], rel=1e-6)
    assert row["verdict"] == "undecided"
    assert "an interval needs at least 5 runs, and there is only 1" in found.sentences[0]
    assert "nees" not in set(found.table["quantity"])
    found.draw(tmp_path / "both.rrd")
    other = fl.compare(file, file, truth=file).table
    assert set(other["second_mean"]) <= {0.0}


def test_what_is_not_alike_is_said(logs: list[Path], estimates: Path, fuselog: Fuselog) -> None:
    folder = estimates.parent / "others"
    fuselog("replay", *logs[:5], "-e", "ekf", "--set", "sigma_range_m=0.2", "--out", folder)
    said = fuselog("compare", estimates, folder, "-e", "ekf", "--json")
    assert said.code == 0
    notes = " ".join(said.json["notes"])
    assert "left out, because only estimates has them: 1 run, landmarks, seed 2, run 5" in notes
    assert "estimator.sigma_range_m" in notes
    assert {row["runs"] for row in said.json["differences"]} == {5}


def test_different_truths_are_said(estimates: Path) -> None:
    [[first, second]] = fl.compare(estimates, estimators=["ekf", "ukf"]).groups
    run = next(iter(second.truths))
    assert not [note for note in unlike_runs(first, second) if "truths" in note]
    moved = replace(second, truths={**second.truths, run: "another"})
    [note] = [note for note in unlike_runs(first, moved) if "truths" in note]
    assert note == f"ekf and ukf have different truths in 1 run: {run}"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["LOG"], "name two estimators"),
        (["LOG", "-e", "ekf"], "has only ekf"),
        (
            ["ESTIMATES", "LOG", "-e", "ekf"],
            "is a log without estimates; create them with fuselog replay",
        ),
        (["ESTIMATES", "-e", "ekf", "-e", "ukff"], "did you mean 'ukf'"),
        (["ONE", "TWO", "-e", "ekf"], "have no run in common"),
        (["EMPTY", "ESTIMATES"], "has no estimates logs"),
        (["ESTIMATES", "TEXT", "-e", "ekf"], "a trajectory file has one run"),
    ],
)
def test_bad_input(
    arguments: list[str],
    sentence: str,
    logs: list[Path],
    estimates: Path,
    fuselog: Fuselog,
    tmp_path: Path,
) -> None:
    (tmp_path / "empty").mkdir()
    text = tmp_path / "text.txt"
    text.write_text("0 1 2 3 0 0 0 1\n", encoding="utf-8")
    places = {
        "LOG": logs[0],
        "ESTIMATES": estimates,
        "ONE": estimates / "run-0.estimates.mcap",
        "TWO": estimates / "run-1.estimates.mcap",
        "EMPTY": tmp_path / "empty",
        "TEXT": text,
    }
    said = fuselog("compare", *(places.get(each, each) for each in arguments))
    assert said.code == 2
    assert sentence in said.err
    assert "Traceback" not in said.err


def test_a_scene_beside_another_leaves_the_other_out() -> None:
    view = rrb.Spatial2DView(origin="/", contents=["map/robot1/**", "map/landmarks/**"], name="Map")
    alone = _alone(view, "ekf", ["ekf", "ukf:2"])
    assert alone.name == "ekf: Map"
    assert alone.id != view.id
    shown = [str(each) for each in alone.contents]
    assert shown[:2] == ["map/robot1/**", "map/landmarks/**"]
    assert shown[2] == "- map/robot1/ukf\\:2/**"


def test_a_row_says_who_is_first_and_stress_withholds_what_it_moves_further() -> None:
    """Each number of a pair in its column; of the candidates the one counts that is moved more."""
    found = Difference(1.0, 3.0, Interval(2.0, 1.5, 2.75), 0.02, "worse", 0.99, 8)
    pair = Paired("ekf", "ukf", "position_rmse_m", "robot1", "low", found, (4.0, 6.0))
    both = [pair, pair._replace(case=ALL, target=3.0, where=None)]
    moved = {"position_rmse_m": 2.5, "position_rmse_m.robot1": 1.0}
    verdicts = {
        "ekf": Stressing("ekf", "sensitive", [], moved),
        "ukf": Stressing("ukf", "harmless", [], {"position_rmse_m.robot1": 1.9}),
    }
    stressed = under_stress(both, verdicts)
    assert [each.stressed for each in stressed] == [1.9, 2.5]
    given: Any = [[SimpleNamespace(pairs=dict.fromkeys(runs)) for runs in ("abc", "bc", "ab")]]
    compared = Differences(given, 0.02, 0.2, [], stressed)
    assert compared.drawable == ["b"]
    table = compared.table
    assert table.iloc[0].to_dict() == {
        "first": "ekf",
        "second": "ukf",
        "quantity": "position_rmse_m",
        "case": "robot1",
        "aim": "low",
        "first_mean": 1.0,
        "second_mean": 3.0,
        "difference": 2.0,
        "low": 1.5,
        "high": 2.75,
        "margin": 0.02,
        "verdict": "worse",
        "sure": 0.99,
        "runs": 8,
        "most_from_s": 4.0,
        "most_to_s": 6.0,
    }
    assert table[["aim", "verdict"]].iloc[1].tolist() == ["3", "withheld"]
    assert table[["most_from_s", "most_to_s"]].iloc[1].isna().all()
    said = "position_rmse_m of robot1: ukf is worse than ekf: 3 against 1; difference 2 (95 % 1.5 to "
    assert stressed[0].sentence == f"{said}2.75), 8 runs, margin 0.02; mostly from 4.0 to 6.0 s"


def test_estimates_under_another_label_are_the_same_but_for_their_names() -> None:
    done = fl.replay(fl.record("landmarks", duration_s=2.0), ["ekf", "ukf"])
    own = done.estimates[0]
    new = Renamed(own, "ukf", "b/c")  # type: ignore[arg-type]
    assert (new.name, new.run, new.epoch_ns, new.start_ns) == (
        own.name,
        own.run,
        own.epoch_ns,
        own.start_ns,
    )
    poses = {old: old.replace("/ukf/", "/b/c/") for old in own.topics if "/ukf/" in old}
    assert new.topics.keys() == {*poses.values()}
    for old, name in poses.items():
        assert new.topics[name].messages == own.topics[old].messages
        for field, column in own.read([old])[old].columns.items():
            np.testing.assert_array_equal(new.read([name])[name][field], column)


@pytest.mark.paper
def test_the_page(fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands give its table, and a check of what has not changed."""
    page = (Path(__file__).parents[2] / "docs" / "compare.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    told = [fuselog(*shlex.split(line)) for line in re.findall(r"^fuselog (.*)$", page, re.MULTILINE)]
    assert [each.code for each in told] == [0] * 5
    row = r"^ (\w+) +(low|high|[\d.]+)((?: +-?[\d.]+){5}) +(\w+)((?: +\d+){2}) *$"
    shown, printed = (
        {
            name: [aim, numbers, *rest]
            for name, aim, numbers, *rest in re.findall(row, text, re.MULTILINE)
        }
        for text in (page, told[2].out)
    )
    assert len(shown) == 4
    for name, (aim, numbers, *rest) in shown.items():
        assert [aim, *rest] == [printed[name][0], *printed[name][2:]]
        values = [float(each) for each in printed[name][1].split()]
        assert [float(each) for each in numbers.split()] == pytest.approx(values, rel=2e-3)
    assert "all 430 fields" in told[4].out
    assert (tmp_path / "check.xml").exists()
    assert {path.suffix for path in Path("compared").rglob("*")} >= {".rrd", ".svg", ".csv", ".json"}


def test_a_component_that_a_run_lacks_counts_in_the_degrees_of_nees() -> None:
    """Of the case that has it in any run, and not of a case that has it in none."""
    rows = pd.DataFrame(
        {
            "estimator": "ekf",
            "estimates": 9,
            "case": ["a", "a", "b", "b"],
            "run": [0, 1, 0, 1],
            "rmse_x_m": [1.0, 2.0, 3.0, 4.0],
            "rmse_heading_rad": [0.1, np.nan, np.nan, np.nan],
        }
    )
    times = pd.DataFrame({"estimator": ["ekf"]})
    assert _stored(rows, times, "ekf", "r", {}).sizes == {("nees", "a"): 2.0, ("nees", "b"): 1.0}
