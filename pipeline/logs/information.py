"""Descriptions of the content of a log and of the cache, as text and as JSON."""

import json
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from fuselog.pipeline.output import RESULT_FILE
from fuselog.pipeline.output.terminal import print_json, print_table, say, say_next, warn
from fuselog.pipeline.runs.inputs import kept_defaults, kept_lists
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.compiling.cache import cache_folder, kept_files
from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.log import Log, NotMcap, RunMetadata, Topic, open_log, read_span
from fuselog.recorders.parameters import build, flat
from fuselog.recorders.registry import available, foreign_code, load
from fuselog.recorders.remote.copies import kept_copies
from fuselog.recorders.remote.paths import RemotePath, partly, size_of
from fuselog.replay.engine.replaying.estimator import Bound, Estimator, bound_to, require_values
from fuselog.replay.engine.replaying.truth import truths_among
from fuselog.replay.engine.streams.linting import lint_source, worst
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.foreign.naming import KINDS as PROGRAMS
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import bind_model, combined, registered_models
from fuselog.replay.inference.model.binding import topics_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.requirements import OWN_MODEL, names_state, nearest, nearest_parts

MOST_TOPICS = 6  # largest number of topics in a line
ESTIMATES = "/estimates/"  # prefix of the topics in estimates logs


def show_log(path: Path, *, is_all: bool, recover: bool, as_json: bool) -> None:
    """Print the run, duration and topics of a log, or how to import other data.

    Result folders and timelines are also described.
    """
    path = partly(path)
    if path.suffix == ".rrd":
        from fuselog.pipeline.logs.made import show_timeline

        show_timeline(path, as_json=as_json)
        return
    if (path / RESULT_FILE).is_file():
        from fuselog.pipeline.logs.made import show_result

        show_result(path, as_json=as_json)
        return
    if path.suffix != ".mcap" or path.is_dir():
        from fuselog.recorders.importers.ros.files.bags import looks_like_bag

        if looks_like_bag(path):
            _show_bag(path, as_json=as_json)
            return
    try:
        log = open_log(path, recover=recover)
    except BadInput as error:
        if not (path.is_dir() or isinstance(error, NotMcap)):
            raise
        command = f"fuselog import table {_quoted(path)}"
        raise BadInput(f"{error}; to import tables, such as CSV: {command}") from error
    if as_json:
        print_json(_as_json(log))
        return
    is_partial = isinstance(path, RemotePath)
    main_ns = None if is_partial else main_span(log)
    first_ns, last_ns = main_ns or read_span(log, "log_time")
    duration_s = (last_ns - first_ns) * 1e-9
    begin = datetime.fromtimestamp(first_ns * 1e-9, UTC)
    span = f"{duration_s:.6g} s from {begin:%Y-%m-%d %H:%M:%S} UTC" if last_ns else "no messages"
    others = "; other messages are years away from these" if main_ns else ""
    say(f"{path}: {size_of(path) / 1e6:.1f} MB, {span}{others}")
    if log.run:
        _say_run(log.run)
    rows = [
        [
            topic.name,
            topic.schema_name,
            topic.messages,
            None if main_ns else rate(topic.messages, duration_s),
        ]
        for topic in log.topics.values()
    ]
    print_table(["topic", "schema", "messages", "per second"], rows)
    if log.mirrors:
        count = sum(topic.messages for topic in log.mirrors.values())
        say(f"Foxglove mirror, for viewers: {count} messages on {len(log.mirrors)} topics")
    for sentence in worst(_findings(log) or [], path):
        say(sentence)
    if is_partial:
        say(
            "The messages are not checked, because that requires reading all of them; to check them: "
            f"fuselog lint {_quoted(path)}"
        )
    if any(topic.encoding in ("cdr", "ros1") for topic in log.topics.values()):
        _say_how_to_import(path)
    elif any(topic.startswith(ESTIMATES) for topic in log.topics):
        _say_what_to_do(path, log)
    elif log.topics:
        _say_what_fits(path, log, is_all=is_all)
    if log.loss_statement:
        warn(log.loss_statement)


def main_span(log: Log) -> tuple[int, int] | None:
    """Return the time span of most messages if all others are years away; otherwise return None."""
    try:
        return LogSource(log).main_span
    except BadInput:
        return None


def _findings(log: Log) -> list[Finding] | None:
    """Check the log with lint and warn of damage; return None if it is read by ranges from a URL."""
    if isinstance(log.path, RemotePath):
        return None
    try:
        return lint_source(LogSource(log), portions=1)
    except BadInput as error:
        warn(f"{error}; its messages are not checked")
        return []


class Fitting(NamedTuple):
    """The result of fitting a model to a log: topics and methods if it fits, or what is missing."""

    topics: list[str]
    methods: list[str]
    lacks: list[str]


def fitting_of(topics: Mapping[str, Topic], *, is_all: bool = True) -> dict[str, Fitting]:
    """Test how registered models fit a log, by name.

    Unless `is_all`, our models of whose types the log has no topic are not imported, and it is not told
    what they lack.
    """
    here, kept = (
        {topic.schema_name for topic in topics.values()},
        {} if is_all else kept_lists()["types"],
    )
    places = {name: entry.value for name, entry in available("models").items()}
    unfit = {name for name, place in places.items() if kept.get(place) and not here & {*kept[place]}}
    models = registered_models(places.keys() - unfit)
    tried = {name: _fitting(model, topics) for name, model in models.items()}
    found = dict.fromkeys(unfit, Fitting([], [], [])) | tried
    return {name: found[name] for name in places if name in found}


def _fitting(model: Model, topics: Mapping[str, Topic]) -> Fitting:
    found = topics_of(model, topics)
    if not any(names_state(each.prior, model) for each in found):
        parts = nearest_parts(model, topics)
        return Fitting([], [], [part.words.replace(".../", "") for part in parts if not part.is_here])
    bound: dict[str, list[Bound]] = {}
    lacks: list[str] = []
    for name, method in METHODS.items():
        if not method.lacks(model):
            try:
                # default values are not validated
                parameters = combined(model, method).model_construct()
                bound[name] = bind_model(name, topics, parameters, model=model, method=method)
            except BadInput as error:
                lacks.append(str(error).removeprefix(f"estimator {name}: "))
    used = _topics_used([one for each in bound.values() for one in each])
    return Fitting(used, list(bound), [] if bound else lacks[:1])


def estimators_that_fit(log: Log) -> dict[str, list[str]]:
    """Find the estimators without a model, such as trackers, that fit a log, with their topics.

    Values are not considered if the log is read by ranges from a URL.
    """
    sources = [] if isinstance(log.path, RemotePath) else [LogSource(log)]
    found: dict[str, list[str]] = {}
    for name in available("estimators"):
        if name not in {*METHODS, *PROGRAMS}:
            with suppress(BadInput):
                estimator = load("estimators", name, Estimator)
                parameters = build(estimator.parameters, {}, f"estimator {name}")
                with foreign_code(f"estimator {name}"):
                    if bound := bound_to(estimator, name, log.topics, parameters):
                        for each in bound if sources else ():
                            require_values(sources, each)
                        found[name] = _topics_used(bound)
    return found


def _topics_used(bound: Sequence[Bound]) -> list[str]:
    return list(dict.fromkeys(topic for one in bound for topic in (*one.static, *one.streams)))


def _say_what_fits(path: Path, log: Log, *, is_all: bool) -> None:
    """Print which models and other estimators fit the log and, with `is_all`, what other models need."""
    fittings = fitting_of(log.topics, is_all=is_all)
    fit = {name: each for name, each in fittings.items() if each.methods}
    others = {name: each for name, each in fittings.items() if name not in fit}
    by_topics: dict[tuple[str, ...], list[str]] = {}
    used = {topic for each in fit.values() for topic in each.topics}
    # other estimators are slow to load and tested only if models do not use all topics
    if is_all or not used.issuperset(set(log.topics) - truths_among(log.topics)):
        for name, topics in estimators_that_fit(log).items():
            by_topics.setdefault(tuple(topics), []).append(name)
    if fit or by_topics:
        say("Estimators that can be replayed over this log:")
    else:
        why = nearest(registered_models(), log.topics)
        say(f"No registered model fits this log: {why}; {OWN_MODEL}")
    for name, each in fit.items():
        say(f"  {name}: -e {' '.join(each.methods)}; from {some_of(each.topics, MOST_TOPICS)}")
    for seen, names in by_topics.items():
        say(f"  without a model: -e {' '.join(names)}; from {some_of(seen, MOST_TOPICS)}")
    if fit and others and not is_all:
        say(f"  {', '.join(others)}: do not fit; --all lists what they need")
    for name, each in others.items() if is_all else ():
        say(f"  {name}: needs {'; '.join(each.lacks)}")
    if known := [*(each.methods for each in fit.values()), *by_topics.values()]:
        say_next("replay", str(path), "-e", known[0][0])


def _say_what_to_do(path: Path, log: Log) -> None:
    """Print which estimators have estimates in a log, and commands for them."""
    labels = dict.fromkeys(
        topic.removeprefix(ESTIMATES).partition("/")[0]
        for topic in log.topics
        if topic.startswith(ESTIMATES)
    )
    place = log.run.notes.get("log") if log.run else None
    of_log = f" of {place}" if place else ""
    say(f"Estimates by {', '.join(labels)}{of_log}: use view, evaluate, compare, diagnose or export")
    say_next("view", str(path))


def _show_bag(path: Path, *, as_json: bool) -> None:
    """Print the topics of a ROS bag that is not an MCAP file."""
    from fuselog.recorders.importers.ros.files.bags import open_bag

    with open_bag(path) as bag:
        rows = [[each.topic, each.type_name, each.messages] for each in bag.connections]
        losses = bag.losses
    if as_json:
        topics = [dict(zip(("topic", "schema", "messages"), row, strict=True)) for row in rows]
        print_json({"path": str(path), "topics": topics, "lost": losses})
        return
    print_table(["topic", "schema", "messages"], rows)
    _say_how_to_import(path)
    for loss in losses:
        warn(loss)


def _say_how_to_import(path: Path) -> None:
    say(f"This is a ROS log; to import it: fuselog import ros {_quoted(path)} -o NAME.mcap")


def show_cache(*, clear: bool, as_json: bool) -> None:
    """Print the number and size of the files in each folder of the cache; with `clear`, delete them."""
    place = cache_folder()
    kept = {*kept_files(), *kept_copies()}
    found: dict[str, dict[str, int]] = {}
    for path in sorted(kept):
        size = found.setdefault(path.parent.name, {"files": 0, "bytes": 0})
        size["files"] += 1
        size["bytes"] += path.stat().st_size
        if clear:
            path.unlink()
    others = sum(path.is_file() for path in place.rglob("*") if path not in kept)
    if as_json:
        print_json({"folder": str(place), "cleared": clear, "holds": found, "others": others})
        return
    say(f"{place}: {'cleared' if clear else 'holds'} {len(kept)} files")
    if found:
        rows = [[name, size["files"], size["bytes"] / 1e6] for name, size in found.items()]
        print_table(["", "files", "MB"], rows)
    if others:
        say(f"{others} other files remain: fuselog did not write them, or they have changed since")


def _as_json(log: Log) -> dict[str, Any]:
    first_ns, last_ns = read_span(log, "log_time")
    topics = [
        {
            "topic": topic.name,
            "schema": topic.schema_name,
            "messages": topic.messages,
            "metadata": dict(topic.metadata),
        }
        for topic in log.topics.values()
    ]
    return {
        "path": str(log.path),
        "first_log_time_ns": first_ns,
        "last_log_time_ns": last_ns,
        "run": asdict(log.run) if log.run else None,
        "topics": topics,
        "findings": None if (found := _findings(log)) is None else [each.as_json for each in found],
        "models": {name: each._asdict() for name, each in fitting_of(log.topics).items()},
        "estimators": estimators_that_fit(log),
        "lost": log.loss_statement,
    }


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def rate(messages: int, duration_s: float) -> float | None:
    """Return the messages per second of a topic, or None if its messages span no time."""
    return messages / duration_s if messages > 1 and duration_s > 0 else None


def _say_run(run: RunMetadata) -> None:
    seed = "imported" if run.seed is None else f"seed {run.seed}, run {run.run}"
    say(f"{run.scenario}, {seed}")
    for name, value in _changed(run).items():
        say(f"  {name} = {json.dumps(value)}")
    for subject, fact in run.notes.items():
        say(f"{subject}: {fact}")


def _changed(run: RunMetadata) -> dict[str, Any]:
    """Return the parameters that differ from the recorder's defaults; all if the recorder is unknown."""
    try:
        defaults = kept_defaults(run.scenario)
    except BadInput:
        return run.parameters
    return {name: value for name, value in flat(run.parameters) if defaults.get(name) != value}
