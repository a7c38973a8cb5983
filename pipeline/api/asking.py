"""Answers to `--set NAME=?`, which prints a parameter's meaning, unit, accepted values and default.

A key of `TAKERS` identifies the kind of object to which the settings of a command belong.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import Any

from fuselog.pipeline.altering.changes import WHATS, is_of_topic, is_parameter
from fuselog.pipeline.api.catalog import Entry, rows_of, stated_of
from fuselog.pipeline.logs.constraints import ConstraintParameters
from fuselog.pipeline.output.terminal import print_table
from fuselog.pipeline.runs.experiment import (
    Experiment,
    Study,
    experiment_of_logs,
    is_of_logs,
    read_experiment,
)
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.pipeline.runs.settings import named_by, read_settings
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import open_log
from fuselog.recorders.parameters import merge, parse_settings
from fuselog.recorders.recording import Recorder
from fuselog.recorders.registry import load
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.replaying.estimator import Estimator, find_estimator
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.observability import OBSERVABILITY

ASKED, OF_MODEL = "=?", " of "
Entries = Sequence[Entry]  # estimators, topics or scenarios with the same settings


def show_meanings(texts: Sequence[str], takes: str, options: Mapping[str, Any]) -> None:
    """Print the meaning of the parameters in `NAME=?` texts; raise BadInput for an unknown name.

    Args:
        texts: the settings; settings without a question mark are skipped.
        takes: a key of `TAKERS`.
        options: the options of the command.
    """
    names = [text.removesuffix(ASKED).strip() for text in texts if text.endswith(ASKED)]
    altering = [name for name in names if is_of_topic(name) and not is_parameter(name)]
    of_topics = [row for name in altering for row in _of_topic(name)]
    others = [name.rpartition(".")[2] if is_of_topic(name) else name for name in names]
    others = [other for name, other in zip(names, others, strict=True) if name not in altering]
    takers = list(TAKERS[takes](options)) if others else []
    table = [*of_topics, *(row for name in others for row in _answer(name, takers))]
    print_table(["parameter", "of", "default", "unit", "accepts", "meaning"], table)


def settings_that_begin(begin: str, takes: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Find the parameters whose names begin with a text, and their meanings, for completion.

    Args:
        begin: the first letters of a name.
        takes: a key of `TAKERS`.
        options: the options of the command that have been parsed so far.
    """
    found: dict[str, str] = {}
    with suppress(BadInput, OSError):
        for entry in chain.from_iterable(TAKERS[takes](options)):
            for name, *_, meaning in rows_of(entry):
                if str(name).startswith(begin):
                    found.setdefault(str(name), str(meaning))
    return found


def _of_topic(name: str) -> Iterator[list[object]]:
    """Yield table rows that describe one setting of a topic, or all settings."""
    topic, _, asked = name.rpartition(".")
    ending = asked.rpartition("_")[2]
    whole = [what for what in WHATS if what == asked]
    for what in whole or [each for each in WHATS if each == f"FIELD_{ending}"] or WHATS:
        yield [f"{topic or name}.{what}", "topic", "", "", "", WHATS[what]]


def _answer(name: str, takers: Sequence[Entries]) -> list[list[object]]:
    """List the table rows that describe one parameter; identical rows of several entries are merged.

    The rows are those of the first group of entries that has the parameter.
    """
    for entries in takers:
        alike: dict[str, tuple[list[object], list[str]]] = {}
        for entry in entries:
            for row in rows_of(entry):
                if f"{row[0]}.".startswith((f"{name}.", f"{name}[")):
                    alike.setdefault(repr(row), (row, []))[1].append(entry.name)
        if alike:
            return [[row[0], ", ".join(_whose(of, alike)), *row[1:]] for row, of in alike.values()]
    known = {str(row[0]) for entries in takers for entry in entries for row in rows_of(entry)}
    raise BadInput(f"--set {name}{ASKED}: no such parameter; {choices(name, sorted(known))}")


def _whose(names: Sequence[str], alike: Collection[Any]) -> Iterable[str]:
    """Name the owners of a parameter, with their models only if the parameter differs between them."""
    return dict.fromkeys(name.partition(OF_MODEL)[0] for name in names) if len(alike) == 1 else names


def _recorder(options: Mapping[str, Any]) -> Iterator[Entries]:
    """Yield the parameters of a scenario, of a log to record again, or of an importer."""
    name, values = options.get("source"), dict[str, Any]()
    if name is None and options["again"] is not None:
        run = open_log(options["again"]).run
        name = run.scenario if run else None
    elif name is None and options["scenario"] is not None:
        name, values, _ = load_scenario(options["scenario"])
    if name is None:
        raise BadInput(f"--set NAME{ASKED}: name a scenario; fuselog scenarios lists them")
    yield [_of_recorder(name, values)]


def _of_recorder(name: str, values: Mapping[str, Any]) -> Entry:
    recorder = load("recorders", name, Recorder)
    return Entry(name, recorder.summary, parameters=recorder.parameters, values=values)


def _estimators(options: Mapping[str, Any]) -> Iterator[Entries]:
    """Yield the parameters of the estimators that a command names."""
    labels = options.get("names") or options.get("labels") or [options.get("label")]
    if not all(labels):
        raise BadInput(f"--set NAME{ASKED}: name an estimator, such as -e ekf")
    programs = named_by(labels)
    labels, tables = list(programs), read_settings(options["settings_file"], programs)
    given = parse_settings(text for text in options["settings"] if not text.endswith(ASKED))
    named = {label: given[label] for label in labels if isinstance(given.get(label), dict)}
    kinds = {label: {"kind": each["kind"]} for label, each in named.items() if "kind" in each}
    chosen = {
        label: merge(merge(tables.get(label, {}), own), kinds.get(label, {}))
        for label, own in programs.items()
    }
    yield from _by_label(chosen, options.get("model"))


def _by_label(
    estimators: Mapping[str, Mapping[str, Any]], model: str | None = None
) -> Iterator[Entries]:
    """Yield each estimator's parameters with its label as prefix, then all parameters without prefix."""
    found = {label: _of_estimator(label, values, model) for label, values in estimators.items()}
    for label, entries in found.items():
        yield [replace(entry, prefix=f"{label}.") for entry in entries]
    yield [entry for entries in found.values() for entry in entries]


def _of_estimator(label: str, values: Mapping[str, Any], model: str | None = None) -> list[Entry]:
    """List the parameters of an estimator for each model that it can estimate, or for `model` only."""
    own = {key: value for key, value in values.items() if key != "kind"}
    kind = values.get("kind", label)
    estimator, variant = (kind, {}) if isinstance(kind, Estimator) else find_estimator(str(kind))
    estimator = estimator.specified(label, own)
    by_model = estimator.parameters_by_model(label, variant)
    if model is not None and by_model and model not in by_model:
        raise BadInput(f"estimator {label}: no model '{model}'; {choices(model, by_model)}")
    if not by_model:
        parameters = estimator.parameters_with(label, variant)
        return [Entry(label, estimator.summary, parameters=parameters, values=own | variant)]
    models = registered_models()
    return [
        Entry(f"{label}{OF_MODEL}{each}", "", {}, parameters, own | variant, stated_of(models[each]))
        for each, parameters in by_model.items()
        if model in (None, each)
    ]


def _experiment(options: Mapping[str, Any]) -> Iterator[Entries]:
    """Yield the parameters of an experiment, its study, its scenario or importer, and its estimators."""
    named, labels = options["experiment"], options["labels"]
    if not named:
        raise BadInput(f"--set NAME{ASKED}: name an experiment; fuselog experiments lists them")
    logs = [located(each) for each in named if is_of_logs(each)]
    stated = experiment_of_logs(logs, labels) if logs else read_experiment(named[0])
    experiment = stated.with_settings({}, {})
    study = load("studies", experiment.study, Study)
    yield [Entry(stated.name, "", parameters=Experiment, values=stated.values)]
    own, values = study.options, experiment.options
    yield [Entry(experiment.study, "", parameters=own, values=values, prefix="options.")]
    if experiment.import_:
        source = experiment.import_
        yield [_of_recorder(source.source, source.parameters)]
    elif experiment.record:
        name, values, _ = load_scenario(experiment.record.scenario)
        yield [_of_recorder(name, values | experiment.record.parameters)]
    yield from _by_label(experiment.estimators)


def _constraints(_: Mapping[str, Any]) -> Iterator[Entries]:
    yield [Entry("constrain", "", parameters=ConstraintParameters)]


def _observability(options: Mapping[str, Any]) -> Iterator[Entries]:
    yield _of_estimator("observability", {"kind": OBSERVABILITY}, options["model"])


TAKERS: Mapping[str, Callable[[Mapping[str, Any]], Iterator[Entries]]] = {
    "recorder": _recorder,
    "estimators": _estimators,
    "experiment": _experiment,
    "constraints": _constraints,
    "observability": _observability,
    "lint": lambda _: iter([()]),  # has only settings of topics
}
