"""Where `--set KEY=VALUE` goes: to the estimators of a replay, or into an experiment."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.experiment import Experiment, load_scenario, read_toml, shipped
from recorders.errors import BadInput, choices
from recorders.parameters import build, describe, merge
from recorders.recording import Recorder
from recorders.registry import load
from replay.engine import configure, find_estimator


def settings_of_estimators(
    labels: Sequence[str], settings: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Parameters by estimator label.

    `ekf.gate_probability=1` goes to ekf, `gate_probability=1` to all that have such a parameter. Raises
    BadInput where none has, or an estimator refuses it.
    """
    chosen: dict[str, dict[str, Any]] = {}
    known: dict[str, set[str]] = {}
    for label in labels:
        own = settings.get(label, {})
        if not isinstance(own, dict):
            raise BadInput(f"--set {label}={own}: expected {label}.PARAMETER=VALUE")
        chosen[label] = dict(own)
        estimator, _ = find_estimator(str(own.get("kind", label)))
        known[label] = set(estimator.parameters.model_fields)
    for key in [each for each in settings if each not in chosen]:
        takers = [label for label in chosen if key in known[label]]
        if not takers:
            names = sorted(set(chosen).union(*known.values()))
            raise BadInput(f"--set {key}: no such estimator or parameter; {choices(key, names)}")
        for label in takers:
            chosen[label].setdefault(key, settings[key])
    for label, values in chosen.items():
        configure(label, values)
    return chosen


def load_experiment(
    name: str, settings: Mapping[str, Any], over: Mapping[str, Any]
) -> tuple[str, Experiment]:
    """An experiment by its shipped name or its TOML file, with settings and then `over` over it.

    A setting goes to the entry of the experiment or to the estimator that its first word names, else to
    the scenario's or importer's parameters: `gap_limit_s=1`, `ekf.gate_probability=1`, `robots=2`.
    """
    known = shipped("experiments")
    if not name.endswith(".toml") and name not in known:
        raise BadInput(f"no experiment '{name}', nor is it a .toml file; {choices(name, known)}")
    path = known.get(name, Path(name))
    values = read_toml(path)
    where = f"experiment {name}"
    own = _settings_of_experiment(build(Experiment, values, where), settings)
    return path.stem, build(Experiment, {**merge(values, own), **over}, where)


def _settings_of_experiment(experiment: Experiment, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings where they belong; raises BadInput where one belongs nowhere."""
    entries = {each.alias or name for name, each in Experiment.model_fields.items()}
    part, names = _parameters_of_source(experiment)
    placed: dict[str, Any] = {}
    for key, value in settings.items():
        if key in entries:
            place: dict[str, Any] = {key: value}
        elif key in experiment.estimators:
            place = {"estimators": {key: value}}
        elif key in names:
            place = {part: {"parameters": {key: value}}}
        else:
            known = sorted(names | entries | experiment.estimators.keys())
            raise BadInput(
                f"--set {key}: no such entry of the experiment, parameter of what it records, "
                f"or estimator; {choices(key, known)}"
            )
        placed = merge(placed, place)
    return placed


def _parameters_of_source(experiment: Experiment) -> tuple[str, set[str]]:
    """Which part of an experiment says where its data come from, and the parameters that this has."""
    if experiment.import_:
        part, recorder = "import", experiment.import_.source
    elif experiment.record:
        part, recorder = "record", load_scenario(experiment.record.scenario)[0]
    else:
        return "", set()
    described = describe(load("recorders", recorder, Recorder).parameters)
    return part, {each.name.partition(".")[0] for each in described}
