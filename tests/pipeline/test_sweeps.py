"""Sweeps: the points that are asked for, and at each what a run of its own gives."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.command_line import main
from fuselog.pipeline.runs import experiment
from fuselog.pipeline.runs.sweeps import (
    curves,
    errors_of_runs,
    heat_maps,
    metrics_of,
    parse_over,
    point_table,
    points_of,
)
from fuselog.recorders.errors import BadInput

pytestmark = pytest.mark.usefixtures("blank_figures")

SHORT = ["--runs", "4", "--set", "duration_s=3"]


def test_points_are_all_of_the_grid_the_last_parameter_first():
    over = [parse_over("ekf.sigma_range_m=0.1:0.4:log3"), parse_over("robots=1,2")]
    points = points_of(over)
    assert [point["robots"] for point in points] == [1, 2] * 3
    assert [point["ekf.sigma_range_m"] for point in points[::2]] == [0.1, 0.2, 0.4]


@pytest.mark.parametrize("sampling", ["sobol", "random"])
def test_samples_fill_the_ranges_and_follow_from_the_seed(sampling):
    over = [parse_over("a=1:100:log2"), parse_over("b=-1:1:2"), parse_over("c=x,y")]
    points = points_of(over, 64, sampling, seed=3)
    assert points == points_of(over, 64, sampling, seed=3)
    assert points != points_of(over, 64, sampling, seed=4)
    table = pd.DataFrame(points)
    assert table["a"].between(1, 100).all()
    assert table["b"].between(-1, 1).all()
    assert set(table["c"]) == {"x", "y"}
    assert np.log10(table["a"]).mean() == pytest.approx(1.0, abs=0.02 if sampling == "sobol" else 0.3)


@pytest.mark.paper
def test_a_sweep_gives_at_every_point_what_a_run_gives(tmp_path, capsys):
    swept = ["--over", "ekf.sigma_range_m=0.05,0.4", "--over", "ekf.gate_probability=0.9,1.0"]
    assert main(["sweep", "landmarks", *swept, *SHORT, "--out", str(tmp_path / "sweep"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    point = result["settings"]["sweep"][1]
    assert point == {"ekf.sigma_range_m": 0.05, "ekf.gate_probability": 1.0}
    single = [f"--set={key}={value}" for key, value in point.items()]
    assert main(["run", "landmarks", *SHORT, *single, "--out", str(tmp_path / "one"), "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    for key, value in alone["metrics"].items():
        assert result["metrics"][key][1] == value, key
    table = pd.read_parquet(tmp_path / "sweep" / "tables" / "sweep.parquet")
    rmse = table[(table["estimator"] == "ekf") & (table["quantity"] == "position_rmse_m")]
    assert (rmse["low"] <= rmse["value"]).all()
    assert (rmse["value"] <= rmse["high"]).all()
    assert len(rmse) == 4
    assert rmse[list(point)].to_dict("records") == result["settings"]["sweep"]
    assert (tmp_path / "sweep" / "figures" / "position_rmse_m-robot1.svg").is_file()
    assert not (tmp_path / "sweep.unfinished").exists()
    assert main(["report", str(tmp_path / "sweep"), "--out", str(tmp_path / "sweep.html")]) == 0


def test_a_row_of_a_sweep_has_what_nine_in_ten_runs_have_and_what_it_should_be() -> None:
    """Of the estimator's own runs and case; consistent filters of three components have a NEES of 3."""
    rmse = np.arange(21.0)
    runs = pd.DataFrame({"estimator": "ekf", "case": "a", "run": range(21), "position_rmse_m": rmse})
    others = [runs.assign(estimator="ukf", position_rmse_m=99.0), runs.assign(case="b", nees=99.0)]
    metrics = {"ekf.position_rmse_m.a": 9.0, "ekf.nees.a": 2.5, "ekf.nis_per_component.a": 1.5}
    metrics |= {"ekf.position_nees.a": 1.75, "ekf.failed_runs.a": 2.0}
    bounds = {"ekf.nees.a": (2.0, 4.0), "ekf.nis_per_component.a": (0.5, 1.25)}
    bounds |= {"ekf.position_nees.a": (1.0, 3.0)}
    judged = {"topic": SimpleNamespace(estimator="ekf", case="a", components="xyh", position="xy")}
    table = pd.concat([runs, *others])
    judge: Any = SimpleNamespace(runs_table=table, metrics=metrics, bounds=bounds, judged=judged)
    rows = point_table(7, {"robots": 2}, judge).set_index("quantity")
    assert {*rows["point"], *rows["robots"], *rows["case"]} == {7, 2, "a"}
    numbers = rows[["value", "low", "high", "aim", "bound_low", "bound_high"]]
    wanted = {
        "position_rmse_m": [9.0, 1.0, 19.0, *[math.nan] * 3],
        "nees": [2.5, math.nan, math.nan, 3.0, 2.0, 4.0],
        "nis_per_component": [1.5, math.nan, math.nan, 1.0, 0.5, 1.25],
        "position_nees": [1.75, math.nan, math.nan, 2.0, 1.0, 3.0],
        "failed_runs": [2.0, *[math.nan] * 5],
    }
    for quantity, values in wanted.items():
        assert numbers.loc[quantity].tolist() == pytest.approx(values, nan_ok=True), quantity
    kept = errors_of_runs(7, judge)
    assert list(kept) == ["point", "estimator", "case", "run", "position_rmse_m"]
    assert (len(kept), {*kept["point"]}) == (63, {7})


def test_curves_of_a_sweep_are_means_over_the_other_parameters() -> None:
    over = [parse_over("a=1,2"), parse_over("b=1,2,4")]
    values = np.array([6.0, 5.0, 4.0, 3.0, 1.0, 2.0])
    table = pd.DataFrame(points_of(over)).assign(estimator="ekf", value=values)
    table = table.assign(low=values - 0.5, high=values + 2.0, point=range(6), quantity="nees", case="")
    chart = curves(table, over, "nees", "robot1")
    for panel, places, means in zip(
        chart.panels, ([1, 2], [1, 2, 4]), ([5.0, 2.0], [4.5, 3.0, 3.0]), strict=True
    ):
        [drawn], [around] = panel.series, panel.bands
        assert (list(drawn.x), list(drawn.y)) == (places, means)
        assert list(around.low) == [each - 0.5 for each in means]
        assert list(around.high) == [each + 2.0 for each in means]
    assert [panel.x.label for panel in chart.panels] == [each.label for each in over]
    assert chart.title.endswith(" of robot1, means over the others; bands: middle 90 % of runs")
    assert metrics_of(table[table["point"] != 2], 6)["ekf.nees"] == pytest.approx(
        [6.0, 5.0, math.nan, 3.0, 1.0, 2.0], nan_ok=True
    )


def test_the_experiment_is_read_once_for_all_points(tmp_path, monkeypatch, capsys):
    read: list[str] = []
    read_toml = experiment.read_toml
    monkeypatch.setattr(experiment, "read_toml", lambda path: read.append(path.name) or read_toml(path))
    swept = ["--over", "ekf.sigma_range_m=0.1,0.2,0.4", "--runs", "2", "--set", "duration_s=3"]
    assert main(["sweep", "landmarks", *swept, "--out", str(tmp_path / "sweep"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["settings"]["sweep"]) == 3
    assert read == ["landmarks.toml"]


def test_the_door_sweeps_as_the_command_does(tmp_path):
    over = {"ekf.sigma_range_m": np.geomspace(0.1, 0.4, 3)}
    out = tmp_path / "sweep"
    folder = fl.sweep("landmarks", over, runs=2, out=out, set={"duration_s": 3})
    assert [each["ekf.sigma_range_m"] for each in folder.result.settings["sweep"]] == [
        pytest.approx(value) for value in (0.1, 0.2, 0.4)
    ]
    values = folder.result.metrics["ekf.position_rmse_m.robot1"]
    assert len(values) == 3
    assert all(math.isfinite(value) for value in values)
    table = pd.read_parquet(out / "tables" / "sweep.parquet")
    of_point = table.drop_duplicates("point")["ekf.sigma_range_m"]
    assert of_point.tolist() == pytest.approx(over["ekf.sigma_range_m"])


def test_a_heat_map_has_the_first_parameter_upwards_and_a_cross_at_the_least():
    over = [parse_over("a=1,2"), parse_over("b=1,2,4")]
    table = pd.DataFrame(points_of(over)).assign(estimator="ekf", value=[6.0, 5.0, 4.0, 3.0, 1.0, 2.0])
    [axes] = [each for each in heat_maps(table, over, "rmse").axes if each.images and each.lines]
    assert axes.images[0].get_array().tolist() == [[6.0, 5.0, 4.0], [3.0, 1.0, 2.0]]
    assert [each.get_text() for each in axes.get_xticklabels()] == ["1", "2", "4"]
    assert [each.get_text() for each in axes.get_yticklabels()] == ["1", "2"]
    assert axes.lines[0].get_xydata().tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("over", "sentence"),
    [
        ("ekf.sigma=1:2:3", "no such"),
        ("robots", "expected KEY=LOW:HIGH:N"),
        ("robots=", "expected KEY=LOW:HIGH:N"),
        ("robots=2:1:3", "LOW below HIGH"),
        ("robots=0:1:log3", "LOW above 0"),
        ("robots=1:2:x", "N at least 2"),
        ("robots=1,1", "each only once"),
        ("duration_s=1:2:200000", "at most 100000 are allowed"),
    ],
)
def test_what_cannot_be_swept_is_bad_input(over, sentence, tmp_path, capsys):
    assert main(["sweep", "landmarks", "--over", over, "--out", str(tmp_path / "sweep")]) == 2
    said = capsys.readouterr().err
    assert sentence in said or (sentence == "no such" and "sigma" in said)
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_a_study_of_its_own_is_not_swept(tmp_path):
    with pytest.raises(BadInput, match="computes more than metrics of single runs"):
        fl.sweep("torus-filter", {"seed": [1, 2]}, out=tmp_path / "sweep")
