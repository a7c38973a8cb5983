"""Descriptions of scenarios, estimators, models, metrics and experiments."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from fuselog.pipeline.output.showing import Shown
from fuselog.pipeline.output.terminal import PrintedTable, print_json, print_table, say
from fuselog.pipeline.runs.experiment import Experiment, Study
from fuselog.pipeline.runs.inputs import load_scenario, shipped
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import build, describe, explain
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.recording import Importer, Recorder
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.replaying.estimator import Estimator, find_estimator
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.formulas import formulas, formulas_by_function
from fuselog.replay.inference.model.binding import serving
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.parameters import ModelParameters, number_fields
from fuselog.replay.inference.requirements import requirements_of
from fuselog.replay.judging.metrics.measuring import Metric


@dataclass(frozen=True, repr=False)
class Entry:
    """The description of a scenario, estimator, model, metric or experiment, with its parameters.

    `stated` contains the parameters that are read from a log's channels unless they are set. `prefix` is
    prepended to the names of parameters when they are set.
    """

    name: str
    what: str
    facts: Mapping[str, str] = field(default_factory=dict)
    parameters: type[BaseModel] | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    stated: Collection[str] = ()
    prefix: str = ""

    def __repr__(self) -> str:
        return f"{self.name}: {self.what}"

    def _repr_html_(self) -> str:
        rows = rows_of(self)
        tables = [PrintedTable("", PARAMETER_COLUMNS, rows)] if rows else []
        facts = PrintedTable("", ["", ""], list(self.facts.items()))
        return Shown(repr(self), tables=[facts, *tables]).html


PARAMETER_COLUMNS = ("parameter", "default", "unit", "accepts", "meaning")
Entries = dict[str, Callable[[], Entry]]  # functions that make the entries, by name


def scenarios() -> Entries:
    """List recorders, and the shipped scenario files."""
    return _registered("recorders", Recorder, _recorder) | _files("scenarios", _scenario)


def estimators() -> Entries:
    """List estimators with their requirements on a log."""
    return _registered("estimators", Estimator, _estimator)


def models() -> Entries:
    """List models with their states, sensors and controls, and the methods that can estimate them."""
    return _registered("models", Model, _model)


def metrics() -> Entries:
    """List the metrics that judge estimates."""
    return _registered("metrics", Metric, _metric)


def experiments() -> Entries:
    """List the shipped experiments."""
    return _files("experiments", _experiment)


LISTS: dict[str, Callable[[], Entries]] = {
    "scenario": scenarios,
    "estimator": estimators,
    "model": models,
    "metric": metrics,
    "experiment": experiments,
}


def show(kind: str, name: str | None, *, as_json: bool) -> None:
    """Print one entry, or all entries as JSON; an entry that cannot be loaded shows its error.

    Raises BadInput if the entry is unknown or cannot be loaded.
    """
    known = LISTS[kind]()
    if name is None:
        entries = [entry_or_why(*each) for each in known.items()]
    else:
        if kind == "estimator" and name.partition(":")[0] in known:
            known[name] = lambda: _estimator(name, *find_estimator(name))
        if name not in known:
            raise BadInput(f"no {kind} '{name}'; {choices(name, known)}")
        entries = [known[name]()]
    if as_json:
        print_json([_as_json(entry) for entry in entries])
    else:
        _print_details(entries[0])


def methods() -> dict[str, dict[str, str]]:
    """For each model, find the methods that can estimate it, and what it lacks for all other methods."""
    return {name: _methods_of(model) for name, model in registered_models().items()}


def types() -> dict[str, list[str]]:
    """For each model, find the types of topics of which a log has one if the model fits it.

    Any log may fit a model that has no such types.
    """
    found: dict[str, list[str]] = {}
    for name, model in registered_models().items():
        sensors = model.all_sensors if model.needs_sensor else ()
        needed = [model.control] if model.control else sensors
        found[name] = sorted({each for one in needed for each in serving(one.schema)})
    return found


def show_formulas(name: str | None, *, as_json: bool) -> None:
    """Print the formulas of a model; raise BadInput if `name` is None or not a known model."""
    if name is None:
        raise BadInput("--formulas needs a model, for example: fuselog models robot --formulas")
    if as_json:
        print_json({"name": name, "formulas": formulas_by_function(name)})
    else:
        for line in formulas(name).splitlines():
            say(line)


def _methods_of(model: Model) -> dict[str, str]:
    """Return for each method "yes" if it can estimate the model, otherwise what the model lacks."""
    lacking = {name: method.lacks(model) for name, method in METHODS.items()}
    return {name: f"no: it lacks {what}" if what else "yes" for name, what in lacking.items()}


def _registered(kind: str, expected: type, described: Callable[[str, Any], Entry]) -> Entries:
    """Make an entry for every registered name."""

    def make(name: str) -> Entry:
        return described(name, load(kind, name, expected))

    return {name: partial(make, name) for name in available(kind)}


def _files(kind: str, described: Callable[[str, Path], Entry]) -> Entries:
    """Make an entry for every shipped file."""
    return {name: partial(described, name, path) for name, path in shipped(kind).items()}


def entry_or_why(name: str, make: Callable[[], Entry]) -> Entry:
    """Make an entry, or one that contains the error message if its module cannot be loaded."""
    try:
        return make()
    except BadInput as error:
        return Entry(name, str(error))


def _scenario(name: str, path: Path) -> Entry:
    recorder, values, _ = load_scenario(name)
    kind = load("recorders", recorder, Recorder).parameters
    facts = {"record with": f"fuselog record {name}"}
    return Entry(name, read_toml(path).get("title", ""), facts, kind, values)


def _recorder(name: str, recorder: Recorder[Any]) -> Entry:
    is_import = isinstance(recorder, Importer)
    command = f"fuselog import {name} PATH" if is_import else f"fuselog record {name}"
    return Entry(name, recorder.summary, {"record with": command}, recorder.parameters)


def _estimator(name: str, estimator: Estimator[Any], variant: Mapping[str, Any] | None = None) -> Entry:
    facts = {"needs": estimator.requirements}
    if variant:
        return Entry(name, estimator.summary, facts, estimator.parameters_with(name, variant), variant)
    if estimator.variant:
        [set_by] = [each for each in describe(estimator.parameters) if each.name == estimator.variant]
        values = set_by.accepts if ", " in set_by.accepts else set_by.meaning
        facts["variants"] = f"{name}:VALUE sets {estimator.variant}: {values}"
    return Entry(name, estimator.summary, facts, estimator.parameters)


def _model(name: str, model: Model) -> Entry:
    facts = {"state": _listed(model.state)}
    for sensor in model.all_sensors:
        of = f" of {', '.join(each.topic for each in sensor.maps)}" if sensor.maps else ""
        taken = " or ".join(serving(sensor.schema))
        facts[f"sensor {sensor.topic}"] = f"{_listed(sensor.measured)}{of} ({taken})"
    for control in [model.control, *model.control.fallbacks] if model.control else []:
        facts[f"control {control.topic}"] = ", ".join(control.components)
    if model.modes:
        facts["modes"] = ", ".join(model.modes)
    if model.augmentable:
        facts["estimable"] = _listed(model.augmentable)
    facts["needs"] = requirements_of(model)
    facts |= {f"by {method}": answer for method, answer in _methods_of(model).items()}
    return Entry(name, model.summary, facts, model.parameters, stated=stated_of(model))


def stated_of(model: Model) -> set[str]:
    """Return the parameters of a model that a log's channels determine unless they are set."""
    own = model.parameters.model_fields.keys() - ModelParameters.model_fields.keys()
    return own & {*number_fields(model.parameters)}


def _listed(components: Mapping[str, str]) -> str:
    """Format components, each followed by its kind unless the kind is linear."""
    return ", ".join(
        name if kind == "linear" else f"{name} ({kind})" for name, kind in components.items()
    )


def _metric(name: str, metric: Metric[Any, Any]) -> Entry:
    return Entry(name, metric.summary, {"judges": metric.judges.__name__})


def _experiment(name: str, path: Path) -> Entry:
    experiment = build(Experiment, read_toml(path), f"experiment {name}")
    facts = {"study": experiment.study, "estimators": ", ".join(experiment.estimators)}
    if experiment.record:
        facts["records"] = f"{experiment.record.scenario}, {experiment.runs} runs"
    if experiment.import_:
        facts["imports"] = f"{experiment.import_.source}; give its path with --data"
    study: Study = load("studies", experiment.study, Study)
    if study.runs != Study.runs:
        facts["--runs"] = study.runs or "not applicable"
    return Entry(name, experiment.title, facts, study.options, experiment.options, prefix="options.")


def _as_json(entry: Entry) -> dict[str, Any]:
    schema = entry.parameters.model_json_schema() if entry.parameters else None
    return {
        "name": entry.name,
        "what": entry.what,
        **{key.replace(" ", "_"): fact for key, fact in entry.facts.items()},
        "parameters": schema,
        "values": dict(entry.values),
    }


def _print_details(entry: Entry) -> None:
    say(f"{entry.name}: {entry.what}")
    for key, fact in entry.facts.items():
        say(f"{key}: {fact}")
    rows = rows_of(entry)
    if rows and entry.parameters:
        print_table(PARAMETER_COLUMNS, rows)
        for place, text in explain(entry.parameters).items():
            for line in ("", *([place] if place else []), *text.splitlines()):
                say(line)


def rows_of(entry: Entry) -> list[list[object]]:
    """List each parameter's name, default, unit, accepted values and meaning."""
    if entry.parameters is None:
        return []
    return [
        [
            f"{entry.prefix}{each.name}",
            _default(each.default, is_stated=each.name in entry.stated),
            each.unit,
            each.accepts,
            each.meaning,
        ]
        for each in describe(entry.parameters, entry.values)
    ]


def _default(value: object, *, is_stated: bool) -> object:
    """Return a parameter's default, or a phrase if a log's channels state the parameter."""
    return "from the log" if value is None and is_stated else value
