"""What `--set NAME=?` answers: what a parameter means, its unit, what it accepts, and its default.

Every command names what takes its settings, by a key of `TAKERS`.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.api.catalog import Entry, rows_of, stated_of
from pipeline.logs.constraints import ConstraintParameters
from pipeline.output.terminal import print_table
from pipeline.runs.experiment import (
    Experiment,
    Study,
    experiment_of_logs,
    load_scenario,
    read_experiment,
)
from pipeline.runs.settings import read_settings
from recorders.errors import BadInput, choices
from recorders.log import open_log
from recorders.recording import Recorder
from recorders.registry import load
from replay.engine.replaying.estimator import Estimator, find_estimator
from replay.inference.estimators import registered_models
from replay.inference.observability import OBSERVABILITY

ASKED, OF_MODEL = "=?", " of "


class Taker(NamedTuple):
    """What takes settings, and how keys begin, such as with `ekf.`; of several the first has a key."""

    begins: str
    entries: Sequence[Entry]


def show_meanings(texts: Sequence[str], takes: str, options: Mapping[str, Any]) -> None:
    """Print what the parameters mean that `NAME=?` asks for; raises BadInput where there is none.

    Args:
        texts: the settings, of which those that are no question are passed over.
        takes: a key of `TAKERS`.
        options: the command's.
    """
    takers = list(TAKERS[takes](options))
    names = [text.removesuffix(ASKED).strip() for text in texts if text.endswith(ASKED)]
    table = [row for name in names for row in _answer(name, takers)]
    print_table(["parameter", "of", "default", "unit", "accepts", "meaning"], table)


def _answer(name: str, takers: Sequence[Taker]) -> list[list[object]]:
    """Rows of one name, of a table with all that is in it; what is alike of several stands once."""
    for taker in takers:
        alike: dict[str, tuple[list[object], list[str]]] = {}
        for entry in taker.entries:
            for key, *row in rows_of(entry):
                full = f"{taker.begins}{key}"
                if f"{full}.".startswith((f"{name}.", f"{name}[")):
                    alike.setdefault(repr((key, row)), ([full, *row], []))[1].append(entry.name)
        if alike:
            return [[row[0], ", ".join(_whose(of, alike)), *row[1:]] for row, of in alike.values()]
    known = {
        f"{taker.begins}{key}"
        for taker in takers
        for entry in taker.entries
        for key, *_ in rows_of(entry)
    }
    raise BadInput(f"--set {name}{ASKED}: no such parameter; {choices(name, sorted(known))}")


def _whose(names: Sequence[str], alike: Collection[Any]) -> Iterable[str]:
    """Whose a parameter is; it is of no interest by which model where all models have it alike."""
    return dict.fromkeys(name.partition(OF_MODEL)[0] for name in names) if len(alike) == 1 else names


def _recorder(options: Mapping[str, Any]) -> Iterator[Taker]:
    """That of a scenario, of a log to record again, or of data to import."""
    name, values = options.get("source"), dict[str, Any]()
    if name is None and options["again"] is not None:
        run = open_log(options["again"]).run
        name = run.scenario if run else None
    elif name is None and options["scenario"] is not None:
        name, values, _ = load_scenario(options["scenario"])
    if name is None:
        raise BadInput(f"--set NAME{ASKED}: name a scenario, one that fuselog scenarios lists")
    yield Taker("", [_of_recorder(name, values)])


def _of_recorder(name: str, values: Mapping[str, Any]) -> Entry:
    recorder = load("recorders", name, Recorder)
    return Entry(name, recorder.summary, parameters=recorder.parameters, values=values)


def _estimators(options: Mapping[str, Any]) -> Iterator[Taker]:
    """Those that a command names."""
    labels = options.get("names") or options.get("labels") or [options.get("label")]
    if not all(labels):
        raise BadInput(f"--set NAME{ASKED}: name an estimator, such as -e ekf")
    tables = read_settings(options["settings_file"], labels)
    yield from _by_label({label: tables.get(label, {}) for label in labels}, options.get("model"))


def _by_label(estimators: Mapping[str, Mapping[str, Any]], model: str | None = None) -> Iterator[Taker]:
    """Estimators by label: first what a label begins, then what is set for all."""
    found = {label: _of_estimator(label, values, model) for label, values in estimators.items()}
    for label, entries in found.items():
        yield Taker(f"{label}.", entries)
    yield Taker("", [entry for entries in found.values() for entry in entries])


def _of_estimator(label: str, values: Mapping[str, Any], model: str | None = None) -> list[Entry]:
    """The parameters of an estimator: for each model that it may estimate, or else all."""
    own = {key: value for key, value in values.items() if key != "kind"}
    kind = values.get("kind", label)
    estimator, variant = (kind, {}) if isinstance(kind, Estimator) else find_estimator(str(kind))
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


def _experiment(options: Mapping[str, Any]) -> Iterator[Taker]:
    """An experiment's own, its study's, its scenario's or importer's, and those of its estimators."""
    named, labels = options["experiment"], options["labels"]
    logs = [Path(each) for each in named if each.endswith(".mcap")]
    stated = experiment_of_logs(logs, labels) if logs else read_experiment(named[0])
    experiment = stated.with_settings({}, {})
    study = load("studies", experiment.study, Study)
    yield Taker("", [Entry(stated.name, "", parameters=Experiment, values=stated.values)])
    yield Taker(
        "options.", [Entry(experiment.study, "", parameters=study.options, values=experiment.options)]
    )
    if experiment.import_:
        source = experiment.import_
        yield Taker("", [_of_recorder(source.source, source.parameters)])
    elif experiment.record:
        name, values, _ = load_scenario(experiment.record.scenario)
        yield Taker("", [_of_recorder(name, values | experiment.record.parameters)])
    yield from _by_label(experiment.estimators)


def _constraints(_: Mapping[str, Any]) -> Iterator[Taker]:
    yield Taker("", [Entry("constrain", "", parameters=ConstraintParameters)])


def _observability(options: Mapping[str, Any]) -> Iterator[Taker]:
    yield Taker("", _of_estimator("observability", {"kind": OBSERVABILITY}, options["model"]))


TAKERS: Mapping[str, Callable[[Mapping[str, Any]], Iterator[Taker]]] = {
    "recorder": _recorder,
    "estimators": _estimators,
    "experiment": _experiment,
    "constraints": _constraints,
    "observability": _observability,
}
