"""Functions that read the inputs of a comparison and group the estimators to compare."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from fuselog.pipeline.api.planning import Kind
from fuselog.pipeline.api.replays import replay
from fuselog.pipeline.comparing.candidates import (
    Candidate,
    Given,
    name_of,
    of_estimates,
    of_replay,
    of_result,
    of_trajectory,
)
from fuselog.pipeline.output.results import RESULT_FILE
from fuselog.pipeline.output.words import count
from fuselog.pipeline.runs.ensemble import Progress
from fuselog.pipeline.runs.estimates import labels_of, recorded_estimators
from fuselog.pipeline.selecting.catalog import recordings_in
from fuselog.recorders.errors import BadInput, choices, some_of
from fuselog.recorders.log import NotMcap, RunMetadata, open_log, schemas, topics_of
from fuselog.recorders.trajectories import read_trajectory
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.judging.errors.trajectory_streams import truth_of

# Largest number of differing settings that a note names.
NAMED = 8
IN_LOGS = ("estimates", "log")


def inputs_of(
    paths: Sequence[Path],
    estimators: Sequence[str | Mapping[str, Kind]],
    set_: Mapping[str, Any],
    truth: str | Path | None,
    case: str | None,
    progress: Progress,
    *,
    gap_limit_s: float,
    recover: bool,
) -> list[Given]:
    """Read the input at every path, and replay logs that do not contain the named estimates."""
    named = named_in(estimators)
    kinds = [kind_of(path, named, recover=recover) for path in paths]
    logs = [path for path, kind in zip(paths, kinds, strict=True) if kind == "log"]
    if logs and len(logs) < len(paths):
        other = next(path for path, kind in zip(paths, kinds, strict=True) if kind != "log")
        raise BadInput(
            f"{logs[0]}: is a log without estimates; create them with fuselog replay, or leave out "
            f"{other}, which is not a log to replay"
        )
    if logs:
        if not estimators:
            raise BadInput(f"{logs[0]}: is a log without estimates; name two estimators: -e ekf -e ukf")
        sources = [LogSource(open_log(path, recover=recover)) for path in logs]
        has = recorded_labels(logs, recover=recover)
        recorded = [each for each in estimators if isinstance(each, str) and each in has]
        others = [each for each in estimators if each not in recorded]
        done = replay(sources, others, gap_limit_s=gap_limit_s, set=set_)
        return [of_replay(name_of(logs[0]), done, gap_limit_s, recorded)]
    if set_:
        raise BadInput(
            f"--set {next(iter(set_))}: applies only to logs that are replayed; {paths[0]} already has "
            "estimates"
        )
    found: dict[int, Given] = {}
    for number, (path, kind) in enumerate(zip(paths, kinds, strict=True)):
        if kind == "result":
            found[number] = of_result(path, progress)
        elif kind == "estimates":
            found[number] = of_estimates(path, gap_limit_s, recover=recover)
    if len(found) < len(paths):
        source = _true_source(truth, list(found.values()))
        topic = _truth_topic(source, case)
        for number, path in enumerate(paths):
            if number not in found:
                found[number] = of_trajectory(path, source, topic, gap_limit_s)
    return [found[number] for number in range(len(paths))]


def named_in(estimators: Sequence[str | Mapping[str, Kind]]) -> list[str]:
    """List the labels of estimators that are given in the form that `replay` accepts."""
    return [label for each in estimators for label in ([each] if isinstance(each, str) else each)]


def with_logs_of_folders(paths: Sequence[Path], labels: Sequence[str], *, recover: bool) -> list[Path]:
    """Replace each folder of logs by the logs in it."""
    found: list[Path] = []
    for path in paths:
        logs = [] if (path / RESULT_FILE).is_file() else recordings_in(path)
        is_replayed = "log" in {kind_of(log, labels, recover=recover) for log in logs}
        found += logs if is_replayed else [path]
    return found


def recorded_labels(paths: Sequence[Path], *, recover: bool) -> list[str]:
    """List the labels of recorded estimates (such as an autopilot's) that all of the logs contain."""
    logs = [path for path in paths if kind_of(path, recover=recover) in IN_LOGS and path.is_file()]
    found = [recorded_estimators(open_log(path, recover=recover)) for path in logs]
    return [label for label in found[0] if all(label in each for each in found)] if found else []


def kind_of(path: Path, labels: Sequence[str] = (), *, recover: bool) -> str:
    """Return the kind of input at a path: "result", "estimates", "log" or "trajectory".

    A recording that contains estimates is a "log" if it has no estimates for one of the `labels`.
    """
    if path.is_dir():
        return "result" if (path / RESULT_FILE).is_file() else "estimates"
    try:
        log = open_log(path, recover=recover)
    except NotMcap:
        return "trajectory"
    recorded = recorded_estimators(log)
    if recorded and any(label not in recorded for label in labels):
        return "log"
    return "estimates" if labels_of(log) else "log"


def _true_source(truth: str | Path | None, others: Sequence[Given]) -> Source:
    """Return the true trajectory as a run if it is given, or else the run of the other candidates."""
    if truth is not None:
        trajectory = read_trajectory(truth)
        stream = truth_of(trajectory, "/truth")
        epoch_ns = int(stream.publish_time_ns[0])
        return MemorySource({"/truth": stream}, RunMetadata("trajectory", epoch_ns=epoch_ns), str(truth))
    sources = {run: source for each in others for run, source in each.sources.items()}
    if len(sources) != 1:
        raise BadInput(
            "a trajectory file has one run: compare it with the estimates log of that run, or give "
            "the true trajectory with --truth"
        )
    return next(iter(sources.values()))


def _truth_topic(source: Source, case: str | None) -> str:
    truths = {
        topic.rpartition("/")[0].removeprefix("/"): topic
        for topic in topics_of(source.topics, schemas.TRUTH_STATE)
    }
    if case is None and len(truths) == 1:
        return next(iter(truths.values()))
    if case not in truths:
        known = some_of(truths) or "none"
        raise BadInput(f"{source.name}: choose the truth of the trajectories with --case: {known}")
    return truths[case]


def comparable_groups(givens: Sequence[Given], labels: Sequence[str]) -> Iterator[list[Candidate]]:
    """Yield groups of candidates: the estimators of one input, or one estimator of several inputs."""
    for each in givens:
        for label in labels:
            if label not in each.labels and (len(each.labels) > 1 or len(givens) == 1):
                raise BadInput(f"{each.name}: no estimates of {label}; {choices(label, each.labels)}")
    if len(givens) == 1:
        chosen = list(labels) or list(givens[0].labels)
        if len(chosen) < 2:
            raise BadInput(f"{givens[0].name}: has only {chosen[0]}; give something to compare it with")
        yield [givens[0].candidate(label, label) for label in chosen]
        return
    names = _distinct([each.name for each in givens])
    common = list(labels) or [x for x in givens[0].labels if all(x in each.labels for each in givens)]
    if not common and all(len(each.labels) == 1 for each in givens):
        yield [each.candidate(each.labels[0], name) for each, name in zip(givens, names, strict=True)]
        return
    if not common:
        problem = "; ".join(f"{each.name} has {', '.join(each.labels)}" for each in givens)
        raise BadInput(
            f"the inputs have no estimator in common: {problem}; name the estimators to compare with -e"
        )
    for label in common:
        suffix = f":{label}" if len(common) > 1 else ""
        yield [
            each.candidate(label if label in each.labels else each.labels[0], name + suffix)
            for each, name in zip(givens, names, strict=True)
        ]


def _distinct(names: Sequence[str]) -> list[str]:
    """Append numbers to names that occur more than once."""
    return [
        f"{name}-{number}" if names.count(name) > 1 else name for number, name in enumerate(names, 1)
    ]


def unlike_runs(first: Candidate, second: Candidate) -> Iterator[str]:
    """Yield sentences about unequal runs, truths and settings; raise BadInput if no run is shared."""
    runs = [list(dict.fromkeys(candidate.rows["run"])) for candidate in (first, second)]
    common = [run for run in runs[0] if run in set(runs[1])]
    if not common:
        problem = " and ".join(f"{each[0]}" if each else "nothing" for each in runs)
        raise BadInput(
            f"{first.name} and {second.name} have no run in common: they begin with {problem}; compare "
            "estimates of the same runs"
        )
    for candidate, own in zip((first, second), runs, strict=True):
        alone = [run for run in own if run not in set(common)]
        if alone:
            yield (
                f"left out, because only {candidate.name} has them: {count(len(alone), 'run')}, "
                f"{', '.join(alone[:3])}" + (", ..." if len(alone) > 3 else "")
            )
    judged = [run for run in common if run in first.truths and run in second.truths]
    apart = [run for run in judged if first.truths[run] != second.truths[run]]
    if apart:
        runs_apart = count(len(apart), "run")
        yield f"{first.name} and {second.name} have different truths in {runs_apart}: {apart[0]}"
    ours, theirs = first.settings or {}, second.settings or {}
    # settings that only one candidate has belong to its method, so they are not compared
    both = {name: (ours[name], theirs[name]) for name in ours if name in theirs}
    differing = [f"{name} {_stated(a)} and {_stated(b)}" for name, (a, b) in both.items() if a != b]
    if differing:
        named = some_of(differing, NAMED)
        yield f"settings differ between {first.name} and {second.name}: {named}"


def _stated(value: Any) -> Any:
    """Format the value of a setting for a sentence."""
    return "not stated" if value is None else value


def table_of_runs(groups: Sequence[Sequence[Candidate]]) -> pd.DataFrame:
    """Make a table with a row per candidate, case and run, with all its metrics."""
    keys = ["case", "run"]
    found = {each.name: each.rows for group in groups for each in group}
    tables = [
        rows.pivot_table("value", keys, "quantity", sort=False).reset_index().assign(estimator=name)
        for name, rows in found.items()
    ]
    return pd.concat(tables, ignore_index=True)
