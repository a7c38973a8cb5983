"""Parameters of estimators as commands receive them, from --set, a settings file and other options."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fuselog.pipeline.altering.changes import by_topic, is_of_topic, is_parameter
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import in_few_words, meanings, merge, parse_settings
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.registry import available
from fuselog.replay.engine.replaying.estimator import Bound, specified
from fuselog.replay.foreign.naming import allowed, of_file, refuse_programs, shorthand, without_named

Value = TypeVar("Value")
Settings = Mapping[str, Mapping[str, Any]]
# Parameters of estimators that have a separate option.
OPTIONS = {"model": "--model", "every_s": "--every"}


def read_settings(path: Path | None, labels: Settings) -> dict[str, dict[str, Any]]:
    """Read parameters by estimator label from the tables of a TOML file; return {} without a file.

    Args:
        path: the file.
        labels: the settings on the command line for each estimator, such as its program.

    Raises BadInput if the file has settings of another estimator, or names another program.
    """
    tables = {} if path is None else of_file(read_toml(path))
    for label, table in tables.items():
        if label not in labels or not isinstance(table, dict):
            raise BadInput(
                f"{path}: has settings of {label}, which is not replayed; a settings file may only have "
                f"tables for the replayed estimators: {', '.join(labels)}"
            )
    tables = {label: without_named(table, labels[label]) for label, table in tables.items()}
    refuse_programs(tables, path)
    return tables


def split_texts(texts: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Split KEY=VALUE texts: return settings of topics by `/TOPIC.WHAT`, and all other texts."""
    of_topics = [text for text in texts if _alters(text)]
    return parse_settings(of_topics), [text for text in texts if text not in of_topics]


def _alters(text: str) -> bool:
    key = text.partition("=")[0].strip()
    return is_of_topic(key) and not is_parameter(key)


def settings_of_estimators(
    labels: Sequence[str], texts: Sequence[str], file: Path | None, **options: Any
) -> dict[str, dict[str, Any]]:
    """Combine parameters by estimator label: a settings file, then KEY=VALUE texts, then options.

    `ekf.gate_probability=1` applies to ekf; `gate_probability=1`, like options that are not None,
    applies to all estimators with such a parameter. Raises BadInput if no estimator has the parameter.
    """
    named = named_by(labels)
    base = read_settings(file, named)
    given = {key: value for key, value in options.items() if value is not None}
    own = {label: merge(base.get(label, {}), stated) for label, stated in named.items()}
    return with_settings(own, allowed(parse_settings(texts)) | given)


def named_by(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the labels and settings for names such as `ekf` and `lib:./mine.so`.

    Raises BadInput if two programs have the same label.
    """
    named: dict[str, dict[str, Any]] = {}
    for label, settings in map(shorthand, names):
        if named.setdefault(label, settings) != settings:
            raise BadInput(f"-e {label}: two programs have this label; rename one, or use an experiment")
    return named


def with_settings(base: Settings, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Apply settings to parameters by estimator label; see `settings_of_estimators`.

    Raises BadInput if no estimator has such a parameter.
    """
    labels, chosen, settings = list(base), dict[str, dict[str, Any]](), by_topic(settings)
    for label in labels:
        own = settings.get(label, {})
        if not isinstance(own, dict):
            raise BadInput(f"--set {label}={own}: expected {label}.PARAMETER=VALUE")
        chosen[label] = dict(own)
    known = parameters_by_label({label: {**base[label], **chosen[label]} for label in labels})
    for key in [each for each in settings if each not in chosen]:
        is_table = is_of_topic(key) and isinstance(settings[key], Mapping)
        takers = [label for label in chosen if ("of_topics" if is_table else key) in known[label]]
        if is_of_topic(key) and not is_table:
            raise BadInput(f"--set {key}: this command does not accept settings of topics; leave it out")
        if not takers and key in OPTIONS:
            raise BadInput(
                f"{OPTIONS[key]}: applies only to methods such as ekf, not to {', '.join(labels)}"
            )
        if not takers and isinstance(settings[key], Mapping) and key in available("estimators"):
            raise BadInput(
                f"--set {key}: {key} is not among the replayed estimators ({', '.join(labels)}); add "
                f"-e {key}"
            )
        if not takers:
            names = sorted(set(chosen).union(*known.values()))
            raise BadInput(f"--set {key}: no such estimator or parameter; {choices(key, names)}")
        for label in takers:
            chosen[label].setdefault(key, settings[key])
    return {label: merge(base[label], own) for label, own in chosen.items()}


def parameters_by_label(estimators: Mapping[str, Mapping[str, Any]]) -> dict[str, set[str]]:
    """Return the names of the estimators' parameters by label; `estimators` contains the settings.

    Raises BadInput if an estimator does not exist.
    """
    names: dict[str, set[str]] = {}
    for label, settings in estimators.items():
        names[label] = set(specified(label, settings)[0].parameters.model_fields)
    return names


def pairs_of(
    option: str, texts: Iterable[str], read: Callable[[str], Value], expected: str
) -> dict[str, Value]:
    """Parse an option's NAME=VALUE texts as a dictionary.

    Raises BadInput, which states the `expected` form, if a text has no name or `read` raises ValueError.
    Also raises BadInput if a name occurs twice.
    """
    found: dict[str, Value] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        if name in found:
            raise BadInput(f"{option} {text}: {name} has a value already; give each name only once")
        try:
            found[name] = read(value)
        except ValueError:
            name = ""
        if not name:
            raise BadInput(f"{option} {text}: expected {expected}")
    return found


def sigmas_of(texts: Sequence[str], option: str) -> dict[str, float]:
    """Parse standard deviations by component from an option's COMPONENT=SIGMA texts."""
    return pairs_of(option, texts, _positive, "COMPONENT=SIGMA with a positive number")


def _positive(text: str) -> float:
    if not 0.0 < (value := float(text)) < math.inf:
        raise ValueError
    return value


def meanings_of(bound: Sequence[Bound]) -> dict[str, dict[str, str]]:
    """Return the meanings of the parameters of estimators, in a few words, by label and name."""
    kinds = {each.name.partition("/")[0]: type(each.parameters) for each in bound if each.parameters}
    return {
        label: {name: in_few_words(meaning) for name, meaning in meanings(kind).items()}
        for label, kind in kinds.items()
    }
