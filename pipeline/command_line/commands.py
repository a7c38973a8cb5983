"""Functions that the commands call: they use the library, then print and write the results.

Rerun, matplotlib, pandas and scipy are slow to import, so only code that draws, tabulates or aligns
imports them.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.api.planning import plan_replay
from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.alarms import as_alarm
from fuselog.pipeline.output.coverage import sentences
from fuselog.pipeline.output.outputs import (
    ESTIMATES,
    PICTURE,
    TIMELINE,
    check_files,
    replaced,
    run_written,
)
from fuselog.pipeline.output.results import (
    RESULT_FILE,
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
    status,
    warn,
)
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import source_of_estimates
from fuselog.pipeline.runs.initial_states import span_of
from fuselog.pipeline.runs.settings import settings_of_estimators, sigmas_of, split_texts
from fuselog.pipeline.selecting.catalog import logs_in
from fuselog.recorders.atomic import scratch_folder, whole_file
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Log, Mirrors, open_log
from fuselog.replay.engine.streams.linting import lint_source, worst
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.errors.moments import Moment
from fuselog.replay.judging.judge import Judge

if TYPE_CHECKING:
    from fuselog.pipeline.presenting.segments import Runs, Segment

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
    _state_losses(source.log for source in plan.sources if isinstance(source, LogSource))
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

    Raises BadInput if two of them would have the same path.
    """
    if out is not None and out.suffix.lower() == ".mcap":
        if len(logs) > 1:
            raise BadInput(f"--out {out}: {len(logs)} logs have one estimates log each; give a folder")
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


def _state_losses(logs: Iterable[Log]) -> None:
    for log in logs:
        if log.loss_statement:
            warn(log.loss_statement)


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
    _state_losses(source.log for source in found.sources)
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
    """Judge a trajectory file against a true one, and print the errors."""
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
            "nees: it is that of one run, and its interval is that of a single step, so a NEES inside "
            "the interval shows only that the filter is not grossly inconsistent; see also "
            "nis_per_component"
        )
    for sentence in [*judge.notes_of_coverage, *unused]:
        say(sentence)
    for moment in judge.worst.values():
        say(_worst(moment, judge.name_of(moment.run) if judge.runs > 1 else ""))
    if details and "seconds" in details:
        print_table(("estimator", "time (s)"), list(details["seconds"].items()))
    for path in written:
        say(str(path))
    if written:
        say_next("report" if written[0].is_dir() else "view", str(written[0]))


def _worst(moment: Moment, run: str = "") -> str:
    where = "".join(f" of {each}" for each in (moment.case, run) if each)
    return f"{moment.estimator}: worst at {moment.elapsed_s:.3f} s{where}: {moment.words}"


def view_path(
    paths: Sequence[Path],
    *,
    runs: str | None,
    port: int | None,
    screenshot: Path | None,
    at: float | str | None,
    start_s: float | None,
    end_s: float | None,
    focus: str | None,
    save: Path | None,
    connect: str | None,
    web: bool,
    gap_limit_s: float,
    recover: bool,
) -> None:
    """Open a path in the viewer, take a screenshot of it, or write or stream its timeline.

    Several runs are shown as a dataset, unless the options are about one run.
    """
    of_one = [at, start_s, end_s, focus, connect]
    is_timeline = any(each is not None for each in of_one) or (save and save.suffix == ".rrd")
    path, segment = paths[0], None
    is_asked = runs is not None or len(paths) > 1 or port is not None
    is_shown_first = is_timeline or screenshot is not None
    if is_asked or (path.is_dir() and not (is_shown_first and (path / RESULT_FILE).is_file())):
        found = _runs_of(paths, gap_limit_s, is_asked=is_asked)
        chosen = [] if found is None else found.chosen(runs or "worst")
        if found is not None and not (is_timeline or (screenshot and len(chosen) == 1)):
            from fuselog.pipeline.presenting.command import save_dataset, show_dataset

            if save is not None:
                save_dataset(found, chosen, save)
            else:
                show_dataset(found, chosen, port=port, web=web, picture=screenshot)
            return
        if found is not None and len(chosen) != 1:
            raise BadInput(
                f"{path}: --at, --start, --end, --focus, --connect and --save FILE.rrd are about one "
                "run; choose it with --runs NUMBER"
            )
        segment, gap_limit_s = (chosen[0], found.gap_limit_s) if found else (None, gap_limit_s)
    _view_one(
        path,
        segment,
        screenshot=screenshot,
        at=at,
        span=(start_s, end_s),
        focus=focus,
        save=save,
        connect=connect,
        web=web,
        gap_limit_s=gap_limit_s,
        recover=recover,
    )


def _runs_of(paths: Sequence[Path], gap_limit_s: float, *, is_asked: bool) -> "Runs | None":
    """Return the runs of results or folders; None if there is only a timeline to show.

    Raises BadInput if several runs are requested and there are none.
    """
    from fuselog.pipeline.presenting.segments import runs_in, runs_of_logs, together
    from fuselog.replay.timeline.catalog import EXTRA, has_catalog

    if len(paths) > 1 and all(path.suffix == ".mcap" for path in paths):
        return runs_of_logs(paths[0], paths, gap_limit_s)
    is_result = (paths[0] / RESULT_FILE).is_file()
    try:
        given = [runs_in(path, gap_limit_s) for path in paths]
    except BadInput as error:
        if is_asked or not is_result:
            raise
        warn(f"{error}; showing the first run")
        return None
    found = [each for each in given if each is not None]
    if len(found) < len(paths):
        if is_asked:
            without = paths[given.index(None)]
            raise BadInput(
                f"{without}: has no row for each run; give results of fuselog run or sweep, such as "
                "those of a comparison, or logs, or leave out --runs and --port"
            )
        return None
    if not is_asked and is_result:
        if len(found[0].segments) < 2:
            return None
        if not has_catalog():
            warn(f"{EXTRA}; showing the first run")
            return None
    return together(found)


def _view_one(
    path: Path,
    segment: "Segment | None",
    *,
    screenshot: Path | None,
    at: float | str | None,
    span: tuple[float | None, float | None],
    focus: str | None,
    save: Path | None,
    connect: str | None,
    web: bool,
    gap_limit_s: float,
    recover: bool,
) -> None:
    """Show, write or stream the timeline of a log, a result or one of its runs (`segment`)."""
    from fuselog.replay.timeline import viewer
    from fuselog.replay.timeline.show import read_moments, worst_at

    is_shown = save is None and connect is None and not web
    if at is not None and screenshot is None and not is_shown:
        raise BadInput(
            f"--at {at}: sets the time cursor of the viewer and of --screenshot; leave it out with "
            "--save, --connect and --web"
        )
    rrd = path / "timeline.rrd" if path.is_dir() else path
    outputs = [(save, TIMELINE), (screenshot, PICTURE)]
    check_files([(out, kind) for out, kind in outputs if out is not None], {"input": [path, rrd]})
    with scratch_folder("fuselog-view") as folder:
        if segment is not None or rrd.suffix != ".rrd":
            rrd = save or folder / "timeline.rrd"
            with status() as told:
                told("drawing the timeline")
                if segment is not None:
                    source, estimates, _ = segment.load()
                    name = f"{path} {segment.name}"
                    judged: Sequence[LogSource | MemorySource] = [estimates] if estimates.topics else []
                else:
                    name = str(path)
                    source, judged = _read_log(path, recover=recover)
                judge = _draw(source, judged, name, rrd, connect, focus, at, span, gap_limit_s)
                if segment is not None and span == (None, None):
                    from fuselog.pipeline.presenting.making import differing

                    for sentence in differing(segment, judge):
                        warn(sentence)
        elif any(given is not None for given in (*span, focus, connect)):
            raise BadInput(
                f"{rrd}: this is a finished timeline; --start, --end, --focus and --connect need a log, "
                "or one run with --runs NUMBER"
            )
        elif save is not None:
            _copy_timeline(rrd, save)
        if isinstance(at, str):
            worst = worst_at([each for each in read_moments(rrd) if focus in (None, each.case)], at)
            say(_worst(worst))
            at = worst.elapsed_s
        if screenshot is not None:
            with status() as told:
                complaints = viewer.screenshot(rrd, screenshot, at_s=at, progress=told)
            for complaint in complaints:
                warn(complaint)
        for written in (save, screenshot):
            if written is not None:
                say(str(written))
        if web:
            viewer.serve(rrd, lambda url: say(f"viewing {path} at {url}; press Ctrl-C to end"))
        elif is_shown and screenshot is None:
            viewer.view(rrd, at_s=at)


def _copy_timeline(rrd: Path, save: Path) -> None:
    if not rrd.is_file():
        raise BadInput(f"{rrd}: no such file; give a result folder with a timeline, or a log")
    with whole_file(save) as new:
        shutil.copyfile(rrd, new)


def _read_log(path: Path, *, recover: bool) -> tuple[LogSource, list[LogSource]]:
    """Open a log, or an estimates log together with its source log; return the run and its estimates."""
    log = open_log(path, recover=recover)
    estimates = source = LogSource(log)
    is_estimates = any(topic.startswith("/estimates/") for topic in log.topics)
    if is_estimates and log.run is not None and "log" in log.run.notes:
        source = source_of_estimates(log, recover=recover)
    elif not is_estimates:
        source = alter(source, {})  # draws a log with several local tangent planes in one of them
    _state_losses([log, source.log])
    return source, [estimates] if is_estimates else []


def _draw(
    source: LogSource | MemorySource,
    estimates: Sequence[LogSource | MemorySource],
    name: str,
    rrd: Path,
    connect: str | None,
    focus: str | None,
    at: float | str | None,
    span: tuple[float | None, float | None],
    gap_limit_s: float,
) -> Judge:
    """Draw a span of a run in seconds, with its estimates if there are any, and judge them."""
    from fuselog.replay.timeline.show import Drawing

    shown = span_of(source, *span, "publish_time")
    worst = at if isinstance(at, str) else None
    with Drawing(
        shown, identity=f"{name} {span}", focus=focus, save=rrd, connect=connect, at=worst
    ) as drawing:
        judged = [replace(each, start_ns=shown.start_ns, end_ns=shown.end_ns) for each in estimates]
        judge = judge_logs(judged, [source], {}, gap_limit_s=gap_limit_s, drawing=drawing)
    for sentence in judge.components_without_truth:
        warn(sentence)
    for topic in source.rejections:
        say(f"{topic}: {source.rejections.sentence(topic)}")
    return judge
