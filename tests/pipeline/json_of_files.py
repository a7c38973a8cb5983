"""What commands print as JSON of logs, of result folders, and of what there is to choose from."""

import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.reader import make_reader

import fuselog as fl
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.log import open_log
from tests.pipeline.conftest import run_here


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers and words with their places; what JSON has no number for is None."""
    if isinstance(value, pd.DataFrame):
        value = value.to_dict("records")
    if isinstance(value, Mapping) and value:
        for name, each in value.items():
            yield from leaves(each, f"{place}/{name}")
    elif isinstance(value, list | tuple) and value:
        for number, each in enumerate(value):
            yield from leaves(each, f"{place}/{number}")
    elif isinstance(value, Mapping | list | tuple):
        yield place, "empty"
    else:
        yield place, None if isinstance(value, float) and not math.isfinite(value) else value


def of_log() -> Any:
    """As the official reader has it; what fits is told by what a replay takes."""
    with Path("grave.mcap").open("rb") as file:
        summary: Any = make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    topics = [
        {
            "topic": each.topic,
            "schema": summary.schemas[each.schema_id].name,
            "messages": counts[each.id],
            "metadata": each.metadata,
        }
        for each in sorted(summary.channels.values(), key=lambda each: each.topic)
    ]
    log = open_log("grave.mcap")
    assert log.run is not None
    assert (log.run.scenario, log.run.seed, log.run.run) == ("navigation", 4, 2)
    [finding] = fl.lint("grave.mcap")
    said = run_here("info", "grave.mcap", "--json").json
    printed, estimators = said["models"], said["estimators"]
    assert {topic for topics in estimators.values() for topic in topics} <= {*log.topics}
    assert estimators.keys() <= {*fl.estimators}
    assert printed.keys() == {*fl.models}
    for name, each in printed.items():
        assert bool(each["methods"]) == (not each["lacks"]) == (name == "inertial")
        assert {*each["topics"]} <= {*log.topics}
    for method in printed["inertial"]["methods"]:
        assert fl.models["inertial"].facts[f"by {method}"] == "yes"
    return {
        "path": "grave.mcap",
        "first_log_time_ns": summary.statistics.message_start_time,
        "last_log_time_ns": summary.statistics.message_end_time,
        "run": asdict(log.run),
        "topics": topics,
        "findings": [finding.as_json],
        "models": printed,
        "estimators": estimators,
        "lost": None,
    }


def of_cut_log() -> Any:
    log = open_log("cut.mcap", recover=True)
    whole = json.loads(run_here("info", "run.mcap", "--json").out)
    stamps = [each.log_time_ns for each in fl.LogSource(log).read([*log.topics]).values()]
    every = np.concatenate(stamps)
    assert log.loss_statement
    return whole | {
        "path": "cut.mcap",
        "first_log_time_ns": int(every.min()),
        "last_log_time_ns": int(every.max()),
        "topics": [
            each | {"messages": log.topics[each["topic"]].messages}
            for each in whole["topics"]
            if each["topic"] in log.topics
        ],
        "lost": log.loss_statement,
    }


def of_result(place: str) -> Any:
    """The file itself, each file of which has the sum that is stated."""
    written = json.loads(Path(place, "result.json").read_text())
    for name, said in written["files"].items():
        if said and name != "result.json":
            assert said == sha256(Path(place, name).read_bytes()).hexdigest()
    there = {str(each.relative_to(place)) for each in Path(place).rglob("*") if each.is_file()}
    assert there == {name.replace("\\", "/") for name in written["files"]}
    return written


def of_catalog(kind: str) -> Any:
    return [
        {
            "name": name,
            "what": each.what,
            **{key.replace(" ", "_"): value for key, value in each.facts.items()},
            "parameters": each.parameters.model_json_schema() if each.parameters else None,
            "values": each.values,  # noqa: PD011
        }
        for name, each in getattr(fl, kind).items()
    ]


def of_parameters() -> Any:
    """The models' own are known once there is a log."""
    gate = {"gate_probability": 1.0}
    own = {"forward_scale": 1.0, "turn_scale": 1.0, "turn_bias_radps": 0.0}
    return {"parameters": {"dead-reckoning": gate | own, "ekf": gate, "ukf": gate | {"kappa": 2.0}}}


def of_sweep() -> Any:
    """A point for each value, whose metrics are those of one run of it."""
    found = of_result("swept")
    assert found["settings"]["sweep"] == [{"robots": 1}, {"robots": 2}]
    return found


def of_formulas() -> Any:
    printed = run_here("models", "robot", "--formulas", "--json").json
    said = fl.formulas("robot")
    for place, formula in leaves(printed["formulas"]):
        assert str(formula) in said, place
    return {"name": "robot", "formulas": printed["formulas"]}


def of_experiments() -> Any:
    """As the files state them."""
    found = of_catalog("experiments")
    for each in found:
        stated = tomllib.loads(shipped("experiments")[each["name"]].read_text(encoding="utf-8"))
        each |= {
            "what": stated["title"],
            "study": stated.get("study", "localization"),
            "estimators": ", ".join(stated.get("estimators", ())),
        }
        assert stated.get("options", {}).items() == each["values"].items()
        if "record" in stated:
            assert each["records"] == f"{stated['record']['scenario']}, {stated.get('runs', 1)} runs"
    return found
