"""Commands that print JSON, and what they are to print: Python's results, or what follows from files."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

import fuselog as fl
from fuselog.pipeline.api.estimates import judge_estimates
from fuselog.pipeline.output.alarms import NOT_TESTED, as_alarm
from fuselog.pipeline.selecting.catalog import rows_in, schema
from fuselog.pipeline.sensing.foreign_files import explained
from fuselog.recorders.log import open_log
from tests.pipeline.json_of_files import (
    of_catalog,
    of_cut_log,
    of_experiments,
    of_formulas,
    of_log,
    of_parameters,
    of_result,
    of_sweep,
)

QUARTER = math.sqrt(0.5)  # half of a quarter turn, its sine and cosine
POSITIVE = "a number above zero"


class Case(NamedTuple):
    """A command, what it is to print, and a function that it calls: of its result, or of nothing."""

    line: str
    wanted: Callable[..., Any]
    calls: str = ""


def rows_of(coverage: Any) -> list[dict[str, Any]]:
    return [each._asdict() for each in coverage]


def metrics_of(table: pd.DataFrame) -> dict[str, Any]:
    """A metric's key is its estimator, quantity and case."""
    columns = table[["estimator", "quantity", "case"]].to_numpy()
    return {".".join(filter(None, key)): each for key, each in zip(columns, table["value"], strict=True)}


def bounds_of(innovations: Mapping[str, int]) -> dict[str, Any]:
    """Where 95 % of a robot's consistent means lie; by label, of so many measured components."""
    return {
        f"{label}.{quantity}.robot1": (chi2.ppf([0.025, 0.975], degrees) / per).tolist()
        for label, count in innovations.items()
        for quantity, degrees, per in (
            ("nees", 3, 1),
            ("position_nees", 2, 1),
            ("nis_per_component", count, count),
        )
    }


def worst_of(errors: pd.DataFrame) -> dict[str, Any]:
    """The moment of the largest NEES of the only run."""
    row = errors.loc[errors["nees"].idxmax()]
    return {"quantity": "nees", "value": row["nees"], "run": str(Path("run.mcap").resolve())} | {
        name: row[name] for name in ("estimator", "case", "time_ns", "elapsed_s")
    }


def degrees_of(done: Any) -> dict[str, int]:
    return done.innovations.groupby("estimator")["degrees"].sum().to_dict()


def judged() -> tuple[Any, dict[str, Any]]:
    """The replay that the case below asks for, with what an evaluation of it says as well."""
    done = fl.replay("run.mcap", "ekf", set={"sigma_range_m": 0.05})
    [row] = done.coverage.to_dict("records")
    log = fl.open("run.mcap").read(["/robot1/range_bearing", "/landmarks"])
    sightings, known = log["/robot1/range_bearing"]["target_id"], log["/landmarks"]["landmark_id"]
    accepted, on_map = int(done.innovations["accepted"].sum()), int(np.isin(sightings, known).sum())
    assert (row["messages"], row["skipped"]) == (len(sightings), 0)
    assert (row["used"], row["gated"]) == (accepted, on_map - accepted)
    assert row["why"] == f"{len(sightings) - on_map} measure targets that are not in the map"
    assert done.losses[0].endswith(row["why"])
    assert [each.kind for each in done.alarms] == ["unused", "innovations"]
    return done, {
        "metrics": metrics_of(done.metrics),
        "bounds": bounds_of(degrees_of(done)),
        "alarms": [as_alarm(each) for each in done.alarms],
        "failures": [],
        "losses": done.losses,
        "worst": {"ekf": worst_of(done.errors)},
        "coverage": [row],
    }


def of_replay() -> Any:
    _, outcome = judged()
    names = ("gate_probability", "forward_scale", "turn_scale", "turn_bias_radps", "fix_delay_s")
    names += ("bias_range_m", "bias_bearing_rad", "bias_heading_rad", "lever_x_m", "lever_y_m")
    fields = fl.models["robot"].parameters.model_fields  # type: ignore[union-attr]
    topics = open_log("run.mcap").topics
    stated = {
        name: f"{value} ({topic})"
        for topic in ("/robot1/odometry", "/robot1/range_bearing")
        for name, value in topics[topic].metadata.items()
    }
    del stated["sigma_range_m"]
    return outcome | {
        "worst": {"ekf": outcome["worst"]["ekf"] | {"run": "run.mcap"}},
        "written": ["again.mcap"],
        "seconds": {"ekf": POSITIVE},
        "parameters": {"ekf": {name: fields[name].default for name in names} | {"sigma_range_m": 0.05}},
        "parameters_of_log": {"ekf": stated},
        "findings": [each.as_json for each in fl.lint("run.mcap")],
    }


def of_evaluated() -> Any:
    return judged()[1] | {"written": ["judged"]}


def of_aligned() -> Any:
    """The lengths between trajectories come beside; of other numbers the API is the judge."""
    found = judge_estimates([Path("est.mcap")], comparison={"align": "se2"})
    _, outcome = judged()
    aligned = found.judge.metrics
    assert 0.0 < aligned["ekf.position_rmse_m.robot1"] < outcome["metrics"]["ekf.position_rmse_m.robot1"]
    assert len(found.compared.metrics) > 20
    losses = [*outcome["losses"], *found.compared.notes]
    moment = found.judge.worst["ekf"]._asdict() | {"run": outcome["worst"]["ekf"]["run"]}
    assert moment["value"] != outcome["worst"]["ekf"]["value"]
    changed = {"metrics": aligned | found.compared.metrics, "losses": losses, "written": []}
    return outcome | changed | {"worst": {"ekf": moment}}


def of_trajectories(found: Any) -> Any:
    """The truth is the estimate, turned about the vertical by 90 degrees, twice as long, and moved."""
    return {
        "metrics": found.metrics,
        "alignment": {
            "rotation": [QUARTER, 0.0, 0.0, QUARTER],
            "translation_m": [1.0, 2.0, 3.0],
            "scale": 2.0,
        },
        "time_offset_s": 0.5,
        "notes": found.notes,
        "written": ["way"],
    }


def of_comparison(found: Any) -> Any:
    first, second = (metrics_of(fl.replay("run.mcap", each).metrics) for each in ("ekf", "ukf"))
    for row in found.table.to_dict("records"):
        key = f"{row['quantity']}.robot1"
        assert row["first_mean"] == pytest.approx(first[f"ekf.{key}"])
        assert row["second_mean"] == pytest.approx(second[f"ukf.{key}"])
        assert row["difference"] == pytest.approx(row["second_mean"] - row["first_mean"], abs=1e-12)
    assert [row.estimator for row in found.coverage] == ["ekf", "ukf"]
    lacking = [note for note in found.notes if "not in the map" in note]
    assert [note.partition(":")[0] for note in lacking] == ["ekf", "ukf"]
    return {
        "differences": found.table,
        "sentences": found.sentences,
        "notes": found.notes,
        "stress": found.stress.sentences if found.stress else [NOT_TESTED],
        "coverage": rows_of(found.coverage),
        "written": ["compared", "both.rrd"],
    }


def of_diagnosis(found: Any) -> Any:
    metrics = metrics_of(found.metrics)
    assert metrics.pop("ekf.log_likelihood.robot1") > found.log_likelihood
    assert found.sentences[0].where == "sigma_range_m"
    return {
        "found": found.told,
        "hypotheses": found.hypotheses,
        "least_gain": found.least_gain,
        "tried": found.tried,
        "sentences": found.causes,
        "components": found.components,
        "notes": found.notes,
        "metrics": metrics | {"ekf.open_gate_log_likelihood": found.log_likelihood},
        "bounds": bounds_of(degrees_of(found.replay)),
        "written": ["why", "why.rrd"],
    }


def of_tuning(found: Any) -> Any:
    """Intervals are even in the logarithms; a half of them is 1.96 errors, which are as in the table."""
    table = found.parameters.set_index("parameter")
    stated = open_log("run.mcap").topics["/robot1/range_bearing"].metadata
    for place, name in enumerate(("sigma_range_m", "sigma_bearing_rad")):
        low, value, high = table.loc[name, ["low", "value", "high"]]
        assert table.loc[name, "start"] == float(stated[name])
        assert value / low == pytest.approx(high / value)
        assert np.log(high / value) == pytest.approx(1.96 * found.standard_errors[place], rel=1e-3)
    held_out = {f"{label}-held-out": values for label, values in found.settings.items()}
    done = [fl.replay("run.mcap", found.settings), fl.replay("other.mcap", held_out)]
    settings = json.loads(Path("tuned/result.json").read_text())["settings"]
    assert settings["estimators"] == found.settings
    kept = {"by": "likelihood", "gap_limit_s": 0.5, "notes": found.notes}
    kept |= {"logs": ["run.mcap"], "held_out": ["other.mcap"]}
    assert {name: settings[name] for name in kept} == kept
    return {
        "logs": ["run.mcap"],
        "held_out": ["other.mcap"],
        **of_search(found, done),
        "written": ["tuned"],
    }


def of_search(found: Any, done: list[Any]) -> Any:
    return {
        "parameters": found.parameters,
        "correlation": found.correlation.to_dict(),
        "notes": found.notes,
        "metrics": {key: value for each in done for key, value in metrics_of(each.metrics).items()},
        "bounds": bounds_of({key: value for each in done for key, value in degrees_of(each).items()}),
    }


def of_calibration(found: Any) -> Any:
    done = [fl.replay("run.mcap", found.settings)]
    assert found.parameters["low"].isna().any()
    return {"logs": ["run.mcap"], "held_out": [], **of_search(found, done), "written": ["calibrated"]}


def of_stress(found: Any) -> Any:
    assert {*found.table["run"], *found.table["estimator"]} == {"run.mcap", "ekf"}
    return {"sentences": found.sentences, "changes": found.table}


def of_observability() -> Any:
    [row] = fl.observability("run.mcap").to_dict("records")
    [covered] = fl.replay("run.mcap", "ekf").coverage.to_dict("records")
    assert row["measurements"] == covered["used"] + covered["gated"]
    return [row | {"run": 0, "case": "robot1", "begin_s": 0.0, "end_s": 3.0, "rank": 3}]


def of_deployment() -> Any:
    """Counts of the costs themselves are in `test_deploying`."""
    written = json.loads(Path("robot_ekf/certificate.json").read_text())
    predict, update = (written["steps"][name] for name in ("predict", "update_range_bearing"))
    assert written["products"]["flops"] < written["products"]["dense_flops"]
    worst = {name: cost + update[name] for name, cost in predict.items()}
    return written | {
        "filter": "robot_ekf",
        "is_root": False,
        "states": 3,
        "worst": worst,
        "steps": {"predict": predict, "update_range_bearing": update},
    }


def of_noise(found: Any) -> Any:
    white = found.columns[0].numbers["white"]
    assert white.low < np.sqrt(0.05) < white.high  # of unit samples, 20 a second
    known = found.curves.dropna()
    assert len(known) > 10
    assert (known["low"] < known["deviation"]).all()
    assert (known["deviation"] < known["high"]).all()
    return {
        "log": "rest.mcap",
        "numbers": found.table,
        "curves": found.curves.to_dict("list"),
        "notes": found.notes,
        "written": ["noise"],
    }


def of_foreign_noise() -> Any:
    return {"path": "imu.yaml", "notes": explained(Path("imu.yaml"))}


def of_ellipsoid(found: Any) -> Any:
    offset = found.table["value"].to_numpy()[:3]
    key = "/imu.magnetic_field_{}_ut_bias"
    stated = {key.format(axis): f"{each:.6g}" for axis, each in zip("xyz", offset, strict=True)}
    assert stated.items() < found.settings.items()
    return {
        "logs": ["turned.mcap"],
        "parameters": found.table,
        "settings": found.settings,
        "notes": found.notes,
        "written": ["ellipsoid"],
    }


def of_check(found: Any) -> Any:
    """Of each stream its columns, and four facts, are compared."""
    done = fl.replay("run.mcap", "ekf")
    topics = [f"/estimates/ekf/robot1/{name}" for name in ("innovation", "pose")]
    columns = [len(each.columns) for each in done.estimates[0].read(topics).values()]
    assert sum(found.fields.values()) == sum(columns) + 8
    return {
        "equal": not found.found,
        "fields": sum(found.fields.values()),
        "first": found.sentences,
        "differences": [each.sentence for each in found.found],
    }


CASES = [
    Case("replay run.mcap -e ekf --set sigma_range_m=0.05 -o again.mcap", of_replay),
    Case("evaluate est.mcap --out judged", of_evaluated),
    Case("evaluate est.mcap --align se2", of_aligned),
    Case(
        "evaluate way.tum --truth turned.tum --align sim3 --time-offset 0.5 --out way",
        of_trajectories,
        "fuselog.pipeline.api.trajectories.evaluate",
    ),
    Case(
        "compare run.mcap -e ekf -e ukf --stress --out compared --save both.rrd",
        of_comparison,
        "fuselog.pipeline.comparing.command.compare",
    ),
    Case(
        "diagnose run.mcap -e ekf --set sigma_range_m=0.03 --out why --save why.rrd",
        of_diagnosis,
        "fuselog.pipeline.diagnosing.command.diagnose",
    ),
    Case("stress run.mcap -e ekf", of_stress, "fuselog.pipeline.stressing.command.stress"),
    Case("observability run.mcap", of_observability),
    Case(
        "tune run.mcap -e ekf --free sigma_range_m --free sigma_bearing_rad --validate other.mcap "
        "--gap-limit 0.5 --out tuned",
        of_tuning,
        "fuselog.pipeline.tuning.command.tune",
    ),
    Case(
        "calibrate run.mcap -e ekf --fixed forward_scale --fixed turn_scale --out calibrated",
        of_calibration,
        "fuselog.pipeline.calibrating.command.calibrate",
    ),
    Case("deploy run.mcap -e ekf -o robot_ekf", of_deployment),
    Case("noise rest.mcap --out noise", of_noise, "fuselog.pipeline.sensing.command.noise"),
    Case("noise imu.yaml", of_foreign_noise),
    Case(
        "ellipsoid turned.mcap --field /imu.magnetic_field_ut --out ellipsoid",
        of_ellipsoid,
        "fuselog.pipeline.calibrating.command.ellipsoid",
    ),
    Case("check run.mcap --against ekf.golden.xz", of_check, "fuselog.pipeline.checking.command.check"),
    Case(
        "check run.mcap --against surer.golden.xz", of_check, "fuselog.pipeline.checking.command.check"
    ),
    Case("info grave.mcap", of_log),
    Case("info cut.mcap --recover", of_cut_log),
    Case("info result", lambda: {"path": "result", **of_result("result")}),
    Case(
        "info made.rrd",
        lambda: {"path": "made.rrd", "timeline": ["made"], "entities": {"/a": 3, "/b/c": 1}},
    ),
    Case(
        "catalog run.mcap",
        lambda: {"logs": rows_in(fl.catalog("run.mcap")[schema().names])},
    ),
    Case(
        "lint grave.mcap",
        lambda: {"path": "grave.mcap", "findings": [each.as_json for each in fl.lint("grave.mcap")]},
    ),
    Case("run landmarks --runs 2 --set duration_s=2 --out again", lambda: of_result("again")),
    Case("run landmarks --set ukf.kappa=2 --parameters", of_parameters),
    Case("sweep landmarks --runs 1 --set duration_s=1 --over robots=1,2 --out swept", of_sweep),
    Case("scenarios", lambda: of_catalog("scenarios")),
    Case("estimators", lambda: of_catalog("estimators")),
    Case("models", lambda: of_catalog("models")),
    Case("metrics", lambda: of_catalog("metrics")),
    Case("experiments", of_experiments),
    Case("models robot --formulas", of_formulas),
]
