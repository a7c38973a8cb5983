"""Functions that `fuselog run` and `fuselog sweep` call, for experiments and for logs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from fuselog.pipeline.api.api import run, sweep
from fuselog.pipeline.logs.cataloguing import select_together
from fuselog.pipeline.output.alarms import NOT_TESTED
from fuselog.pipeline.output.results import RESULT_FILE, RUNS, keep, read_table, split_metric
from fuselog.pipeline.output.terminal import (
    has_many_cases,
    print_claims,
    print_json,
    print_metrics,
    print_others,
    print_parameters,
    print_table,
    print_worst,
    progress,
    say,
    say_next,
)
from fuselog.pipeline.runs.experiment import (
    Experiment,
    Stated,
    experiment_of_logs,
    is_of_logs,
    read_experiment,
    require_campaign,
)
from fuselog.pipeline.runs.settings import read_settings
from fuselog.pipeline.runs.sweeps import DRAWN, parse_over
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import merge, parse_settings
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.foreign.naming import allowed


def run_named(
    named: Sequence[str],
    labels: Sequence[str],
    over: Mapping[str, Any],
    *,
    logs: int,
    errors: bool,
    data: Path | None,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    diagnose: bool,
    stress: bool,
    tells_parameters: bool,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    where: str | None,
) -> None:
    """Run an experiment, or replay logs as an experiment, and print its metrics and claims.

    If `tells_parameters` is set, print only the parameters of the experiment's estimators.
    """
    stated, values = _stated_experiment(named, labels, over, settings_file, settings, where)
    if data is not None and stated.source.endswith(".mcap"):
        raise BadInput(
            f"{stated.source}: --data does not apply to logs, which are replayed as they are; leave it "
            f"out"
        )
    if tells_parameters:
        _tell_parameters(stated.with_settings(values, {}), as_json=as_json)
        return
    if workers is not None or scheduler is not None:
        experiment = stated.with_settings(values, {})
        require_campaign(experiment, "leave out --workers and --scheduler")
    done = run(
        stated,
        data=data,
        out=out,
        logs=logs,
        errors=errors,
        workers=workers,
        scheduler=scheduler,
        set=values,
        progress=progress,
    )
    result = done.result
    if diagnose:
        from fuselog.pipeline.diagnosing.likeliest import likeliest_causes

        result = keep(done.folder, result, causes=likeliest_causes(done.folder, result))
    if stress:
        from fuselog.pipeline.stressing.experiments import claims_under_stress, stress_result

        found = stress_result(result, workers=workers, scheduler=scheduler, progress=progress)
        claims = claims_under_stress(stated.with_settings(values, {}), result, found)
        result = keep(done.folder, result, stress=found, claims=claims)
    if as_json:
        print_json(result.model_dump(mode="json"))
        return
    print_worst(result.alarms)
    for cause in result.causes:
        say(f"most likely cause for {cause.estimator}: {cause.words} {cause.mended}".rstrip())
    if result.claims or has_many_cases(result.metrics):
        from fuselog.pipeline.output.report.kinds import run_sentences  # slow to import

        say(" ".join(run_sentences(result, done.folder)))
    runs = done.folder / RUNS
    details = done.folder / (
        "tables/summary.csv" if "tables/summary.csv" in result.files else RESULT_FILE
    )
    table = read_table(runs) if runs.is_file() else None
    print_metrics(result.metrics, result.bounds, table, str(details))
    print_others(result.alarms)
    print_claims(result.claims)
    say(*(word for each in result.stress for word in each.words))
    if not result.stress and result.settings.get("estimators"):
        say(NOT_TESTED)
    say(f"{done.folder}: {', '.join(result.contents)}")
    if table is not None and result.settings.get("runs", 1) > 1:
        say(f"to see the worst runs: fuselog view {quote(str(done.folder))}")
    say_next("report", str(done.folder))


def _tell_parameters(experiment: Experiment, *, as_json: bool) -> None:
    """Print the parameters of an experiment's estimators, including defaults."""
    parameters = {
        label: configure(label, values)[1].model_dump(mode="json", exclude_none=True)
        for label, values in experiment.estimators.items()
    }
    if as_json:
        print_json({"parameters": parameters})
        return
    print_parameters(parameters)
    say("model parameters that are not listed are read from the log; see fuselog replay --help")


def _stated_experiment(
    named: Sequence[str],
    labels: Sequence[str],
    over: Mapping[str, Any],
    settings_file: Path | None,
    settings: Sequence[str],
    where: str | None,
) -> tuple[Stated, dict[str, Any]]:
    """Read the experiment (a name, a TOML file, or logs) and the settings that override its own."""
    files = [located(each) for each in named if is_of_logs(each)]
    if files and (len(files) < len(named) or over.keys() & {"runs", "seed"}):
        raise BadInput(
            f"{files[0]}: logs are replayed as they are; give only logs and -e, without --runs and "
            f"--seed"
        )
    if not files and (len(named) > 1 or labels):
        raise BadInput(
            f"{named[0]}: give one experiment at a time, without -e; it names its own estimators"
        )
    if where is not None and not files:
        raise BadInput(f"--where {where}: selects logs; give a catalog, or folders of logs")
    if where is None and all(path.suffix == ".mcap" for path in files):
        stated = experiment_of_logs(files, labels) if files else read_experiment(named[0])
    else:
        chosen = select_together(files, where)
        stated = experiment_of_logs(chosen.logs, labels, chosen.unreadable)
    values = merge(read_settings(settings_file, stated.labels), allowed(parse_settings(settings)))
    files = [*stated.files, *filter(None, [settings_file])]
    return stated._replace(files=files), {**values, **over}


def sweep_named(
    named: Sequence[str],
    labels: Sequence[str],
    over: Mapping[str, Any],
    *,
    swept: Sequence[str],
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    where: str | None,
    **options: Any,
) -> None:
    """Run an experiment (or replay logs as one) at many points, and print the metrics at each point.

    The other options are those of `sweep`.
    """
    overs = [parse_over(text) for text in swept]
    stated, values = _stated_experiment(named, labels, over, settings_file, settings, where)
    done = sweep(stated, overs, set=values, progress=progress, **options)
    result = done.result
    if as_json:
        print_json(result.model_dump(mode="json"))
        return
    points = result.settings["sweep"]
    drawn = {key: value for key, value in result.metrics.items() if split_metric(key)[1] in DRAWN}
    lists = {key: value for key, value in drawn.items() if isinstance(value, list)}
    shown = {key: value for key, value in lists.items() if len({*value}) > 1} or lists
    rows = [
        [*point.values(), *(value[number] for value in shown.values())]
        for number, point in enumerate(points)
    ]
    print_table([*points[0], *shown], rows)
    say(f"{done.folder}: a table of all metrics, figures, result.json")
    say(f"to see the worst runs: fuselog view {quote(str(done.folder))}")
    say_next("report", str(done.folder))
