"""Functions that the commands call: they use the library, then print and write the results.

Rerun, matplotlib, pandas and scipy are slow to import, so only code that draws, tabulates or aligns
imports them.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.planning import plan_replay
from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.alarms import as_alarm
from fuselog.pipeline.output.coverage import sentences
from fuselog.pipeline.output.outputs import (
    ESTIMATES,
    TIMELINE,
    check_files,
    replaced,
    run_written,
)
from fuselog.pipeline.output.results import (
    in_order,
    plain,
    split_metric,
)
from fuselog.pipeline.output.terminal import (
    print_json,
    print_metrics,
    print_others,
    print_parameters,
    print_pose_errors,
    print_table,
    print_worst,
    progress,
    say,
    say_next,
    warn,
    warn_of_losses,
)
from fuselog.pipeline.runs.settings import settings_of_estimators, sigmas_of, split_texts
from fuselog.pipeline.selecting.catalog import logs_in
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Mirrors, open_log
from fuselog.replay.engine.streams.linting import lint_source, worst
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.judging.judge import Judge

MOST_LOGS = 5  # number of logs whose findings are printed


def replay_logs(
    logs: list[Path],
    names: list[str],
    *,
    out: Path | None,
    model: str | None,
    every_s: float | None,
    arrival_order: bool,
    late: str | None,
    start_s: float | None,
    end_s: float | None,
    origins: Sequence[str],
    sigmas: Sequence[str],
    save: Path | None,
    connect: str | None,
    foxglove: bool,
    recover: bool,
    gap_limit_s: float,
    tells_parameters: bool,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> bool:
    """Replay logs, write the estimates logs, judge them if there is truth, and print the metrics.

    Returns whether every estimator completed at least one run.
    """
    logs = [log for path in logs for log in logs_in(path)]
    paths = _estimate_paths(logs, out)
    timelines = [] if save is None else [(save, TIMELINE)]
    given = [settings_file] if settings_file else []
    inputs = {"log": logs, "start": [Path(origin) for origin in origins], "settings": given}
    check_files([*((path, ESTIMATES) for path in paths), *timelines], inputs)
    before = {path: run_written(path) for path in paths}
    alterations, own = split_texts(settings)
    estimators = settings_of_estimators(names, own, settings_file, model=model, every_s=every_s)
    plan = plan_replay(
        (LogSource(open_log(path, recover=recover)) for path in logs),
        estimators,
        start_s=start_s,
        end_s=end_s,
        start_from=origins,
        start_sigma=sigmas_of(sigmas, "--start-sigma"),
        gap_limit_s=gap_limit_s,
        arrival_order=arrival_order,
        late=late,
        set=alterations,
    )
    done = plan.replay(
        list(zip(paths, logs, strict=True)),
        save=save,
        connect=connect,
        mirrors=mirrors_if(foxglove),
        progress=progress,
    )
    for path, run in before.items():
        if run is not None and (sentence := replaced(path, run, run_written(path))):
            warn(sentence)
    for path in paths[:1]:
        say_left_out(path, foxglove)
    warn_of_losses(source.log for source in plan.sources if isinstance(source, LogSource))
    if tells_parameters and not as_json:
        print_parameters(done.parameters, done.stated)
    details = {
        "seconds": dict(done.seconds),
        "parameters": done.parameters,
        "parameters_of_log": done.stated,
        "coverage": [row._asdict() for row in done.coverage],
    }
    found = {
        path: lint_source(source, portions=1) for path, source in zip(logs, plan.sources, strict=True)
    }
    details["findings"] = [each.as_json for of_log in found.values() for each in of_log]
    if not as_json:
        for path in [path for path, of_log in found.items() if of_log][:MOST_LOGS]:
            say(next(worst(found[path], path)))
    alarms = alarms_of(done.judge, done.parameters, done.coverage)
    unused = sentences(done.coverage)
    _print_outcome(
        done.judge,
        list(estimators),
        alarms,
        as_json=as_json,
        written=[*paths, *([save] if save else [])],
        details=details,
        unused=unused,
    )
    failed_runs = [
        value for key, value in done.judge.metrics.items() if split_metric(key)[1] == "failed_runs"
    ]
    return max(failed_runs, default=0) < len(logs)


def say_left_out(path: Path, foxglove: bool) -> None:
    """If `foxglove` is set, warn about streams of a new log that have no equivalent Foxglove message."""
    if foxglove:
        from fuselog.pipeline.logs.foxglove import left_out

        if sentence := left_out(open_log(path)):
            warn(f"{path}: {sentence}")


def mirrors_if(foxglove: bool) -> Mirrors | None:
    """Import and return the Foxglove mirror only if it is requested, because the import is slow."""
    if not foxglove:
        return None
    from fuselog.pipeline.logs.foxglove import mirrors

    return mirrors


def _estimate_paths(logs: Sequence[Path], out: Path | None) -> list[Path]:
    """Choose the path of each log's estimates log: next to the log, the given file, or in a folder.

    Raises BadInput if two estimates logs would have the same path.
    """
    if out is not None and out.suffix.lower() == ".mcap":
        if len(logs) > 1:
            raise BadInput(
                f"--out {out}: each of the {len(logs)} logs gets its own estimates log; give a folder"
            )
        return [out]
    if out is not None and out.suffix and not out.is_dir():
        raise BadInput(f"--out {out}: expected a name that ends in .mcap, or an existing folder")
    paths = [(out or log.parent) / f"{log.stem}.estimates.mcap" for log in logs]
    places = [path.resolve() for path in paths]
    for path, place in zip(paths, places, strict=True):
        if places.count(place) > 1:
            raise BadInput(
                f"{path}: the estimates of two logs would have this name; replay the logs one by one"
            )
    return paths


def evaluate_logs(
    estimates: list[Path],
    logs: list[Path],
    *,
    comparison: Mapping[str, Any],
    out: Path | None,
    metrics: Sequence[str],
    errors: bool,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
) -> None:
    """Judge estimates logs with `judge_estimates`, and print the metrics."""
    from fuselog.pipeline.api.estimates import judge_estimates

    found = judge_estimates(
        estimates,
        logs,
        comparison=comparison,
        out=out,
        metrics=metrics,
        errors=errors,
        recover=recover,
        gap_limit_s=gap_limit_s,
    )
    warn_of_losses(source.log for source in found.sources)
    _print_outcome(
        found.judge,
        found.estimators,
        alarms_of(found.judge, found.estimators, found.coverage),
        as_json=as_json,
        written=[out] if out else [],
        details={"coverage": [row._asdict() for row in found.coverage]},
        more=found.compared.metrics,
        unused=[*sentences(found.coverage), *found.compared.notes],
    )


def evaluate_trajectory(
    estimates: Sequence[Path],
    truth: Path,
    formats: Mapping[str, Any],
    comparison: Mapping[str, Any],
    *,
    logs: Sequence[Path],
    out: Path | None,
    metrics: Sequence[str],
    errors: bool,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
) -> None:
    """Judge a trajectory file against a file with the true trajectory, and print the errors."""
    from fuselog.pipeline.api.trajectories import evaluate

    if len(estimates) > 1:
        raise BadInput(f"{estimates[1]}: only one trajectory can be judged at a time; remove the others")
    if logs or metrics or errors or recover:
        raise BadInput(
            "--log, --metric, --errors and --recover apply to logs, and --truth to trajectory files; "
            "do not combine them"
        )
    done = evaluate(estimates[0], truth=truth, gap_limit_s=gap_limit_s, **formats, **comparison)
    written = [] if out is None else [done.save(out).folder]
    for sentence in done.notes:
        warn(sentence)
    if as_json:
        print_json(
            {
                "metrics": done.metrics,
                "alignment": done.alignment,
                "time_offset_s": done.compared.time_offset_s,
                "notes": done.notes,
                "written": [str(path) for path in written],
            }
        )
        return
    print_pose_errors(done.metrics)
    if done.compared.time_offset_s:
        say(f"{done.compared.time_offset_s:.6f} s were added to the stamps of the estimates")
    if done.comparison.align == "sim3":
        say(f"the estimates were scaled by {done.alignment['scale']:.6f}")
    for path in written:
        say(str(path))


def _print_outcome(
    judge: Judge,
    estimators: Iterable[str],
    alarms: Sequence[Finding],
    *,
    as_json: bool,
    written: Sequence[Path],
    details: Mapping[str, Any] | None = None,
    more: Mapping[str, float] | None = None,
    unused: Sequence[str] = (),
) -> None:
    values = in_order(plain({**judge.metrics, **(more or {})}), estimators)
    failures = judge.failures
    for sentence in [*judge.components_without_truth, *failures[:5]]:
        warn(sentence)
    if len(failures) > 5:
        warn(f"{len(failures)} failures in total")
    if as_json:
        outcome = {
            "metrics": values,
            "bounds": judge.bounds,
            "alarms": [as_alarm(each) for each in alarms],
            "failures": failures,
            "losses": [*judge.notes_of_coverage, *unused],
            "worst": {
                estimator: moment._asdict() | {"run": judge.name_of(moment.run)}
                for estimator, moment in judge.worst.items()
            },
            "written": [str(path) for path in written],
        }
        print_json(outcome | dict(details or {}))
        return
    print_worst(alarms)
    runs = judge.runs_table if judge.runs > 1 else None  # imports pandas, which is slow
    print_metrics(values, judge.bounds, runs)
    print_others(alarms)
    if judge.runs == 1 and any(split_metric(key)[1] == "nees" for key in judge.bounds):
        say(
            "nees: the value is from one run, and its interval is for a single step, so a value inside "
            "the interval shows only that the filter is not grossly inconsistent; see also "
            "nis_per_component"
        )
    for sentence in [*judge.notes_of_coverage, *unused]:
        say(sentence)
    for moment in judge.worst.values():
        say(moment.sentence(judge.name_of(moment.run) if judge.runs > 1 else ""))
    if details and "seconds" in details:
        print_table(("estimator", "time (s)"), list(details["seconds"].items()))
    for path in written:
        say(str(path))
    if written:
        say_next("report" if written[0].is_dir() else "view", str(written[0]))
