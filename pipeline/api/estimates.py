"""Evaluation of estimates logs against the truth in their source logs, as in `fuselog evaluate`."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuselog.pipeline.altering.sources import setting_of
from fuselog.pipeline.api.trajectories import ComparedLogs, compare_logs
from fuselog.pipeline.output.coverage import recounted
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.output.results import result_folder, write_outcome
from fuselog.pipeline.output.summary import summarise, summary_table
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import (
    ErrorTables,
    hash_files,
    log_of_estimates,
    source_of_estimates,
    stated_estimators,
)
from fuselog.pipeline.runs.initial_states import check_same_run
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import NotMcap, open_log
from fuselog.replay.engine.replaying.usage import Row
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.judging.errors.trajectories import Comparison
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import find_metrics


@dataclass(frozen=True)
class JudgedLogs:
    """Estimates logs that were compared with the truth.

    Attributes:
        sources: the estimates logs, then the logs with the truth.
        estimators: settings by label, from the first estimates log.
        judge: the metrics of all runs.
        compared: the estimates compared as trajectories, if this was requested.
        coverage: how many messages of every topic were used.
    """

    sources: Sequence[LogSource]
    estimators: Mapping[str, Any]
    judge: Judge
    compared: ComparedLogs
    coverage: Sequence[Row]


def judge_estimates(
    estimates: Sequence[Path],
    logs: Sequence[Path] = (),
    *,
    comparison: Mapping[str, Any],
    out: Path | None = None,
    metrics: Sequence[str] = (),
    errors: bool = False,
    recover: bool = False,
    gap_limit_s: float = 0.2,
) -> JudgedLogs:
    """Compare estimates logs with the truth, where each log is one run.

    Args:
        estimates: the estimates logs.
        logs: the logs with the truth; by default those from which the estimates were replayed.
        comparison: entries of a `Comparison`. If given, positions are also compared as trajectories, and
            estimates are judged after alignment with the truth.
        out: a result folder to write.
        metrics: names of the metrics to compute; all if empty.
        errors: whether the folder keeps all individual errors.
        recover: read the intact part of truncated or damaged logs.
        gap_limit_s: the longest gap over which the truth is interpolated.

    Raises BadInput if a log has no estimates or is from another run, or if there is nothing to judge.
    """
    if errors and out is None:
        raise BadInput(
            "--errors: individual errors are written into a result folder; give one with --out"
        )
    if logs and len(logs) != len(estimates):
        raise BadInput(f"{len(estimates)} estimates logs and {len(logs)} --log; give one --log for each")
    opened = [_opened(path, recover=recover) for path in estimates]
    places = logs or [log_of_estimates(each.log) for each in opened]
    if out is not None:
        check_folder(out, {"input": [*estimates, *places]})
    sources = [
        source_of_estimates(each.log, place, recover=recover)
        for each, place in zip(opened, places, strict=True)
    ]
    for each, source in zip(opened, sources, strict=True):
        check_same_run(each, source)
    wanted = find_metrics(metrics)
    estimators = stated_estimators(opened[0])
    compared = _compared(opened, sources, comparison, gap_limit_s)
    with result_folder(out) if out is not None else nullcontext() as folder:
        with ErrorTables(folder) if folder and errors else nullcontext() as kept:
            judge = judge_logs(
                compared.estimates,
                sources,
                wanted,
                gap_limit_s=gap_limit_s,
                on_errors=kept.add if kept else None,
            )
        if not judge.has_numbers:
            raise BadInput(
                f"{estimates[0]}: there is nothing to judge, neither estimates with truth nor "
                "innovations; give the source log with --log"
            )
        coverage = recounted(opened, sources, estimators, judge.doubts)
        if folder is not None:
            settings = {
                "title": f"estimates of {sources[0].name}",
                "estimates": [str(path) for path in estimates],
                "logs": [source.name for source in sources],
                "estimators": estimators,
                "gap_limit_s": gap_limit_s,
                "metrics": list(metrics),
                **setting_of(sources[0]),
                **comparison,
            }
            outcome = summarise(judge, coverage, estimators)
            outcome.metrics.update(compared.metrics)
            outcome.tables["summary"] = summary_table(outcome.metrics)
            outcome.figures.update(compared.figures)
            outcome.input_sha256, outcome.kind = hash_files([*estimates, *places]), "evaluate"
            write_outcome(folder, "evaluate", settings, outcome)
    return JudgedLogs([*opened, *sources], estimators, judge, compared, coverage)


def _opened(path: Path, *, recover: bool) -> LogSource:
    """Open an estimates log; raise BadInput if the file is not an estimates log."""
    try:
        log = open_log(path, recover=recover)
    except NotMcap as error:
        raise BadInput(f"{error}, or give the true trajectory with --truth") from error
    if not any(topic.startswith("/estimates/") for topic in log.topics):
        raise BadInput(f"{path}: the log has no estimates; give a log that fuselog replay wrote")
    return LogSource(log)


def _compared(
    estimates: Sequence[LogSource],
    sources: Sequence[LogSource],
    comparison: Mapping[str, Any],
    gap_limit_s: float,
) -> ComparedLogs:
    """Compare the estimates as trajectories, with alignment if requested."""
    if not comparison:
        return ComparedLogs(estimates, {})
    if "time_offset_s" in comparison:
        raise BadInput(
            "--time-offset works only for trajectory files, because all streams of a log have one "
            "clock; leave it out"
        )
    how = Comparison(**{"association": "interpolated", "gap_limit_s": gap_limit_s, **comparison})
    compared = compare_logs(estimates, sources, how)
    if not compared.compared:
        raise BadInput(
            f"{estimates[0].name}: there are no estimated positions with truth to align; leave "
            "out --align"
        )
    return compared
