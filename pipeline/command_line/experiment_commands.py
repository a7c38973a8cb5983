"""What `fuselog run` and `fuselog sweep` do: experiments, or logs as one, at one point or many."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.output.outputs import check_folder
from pipeline.output.results import RUNS, read_table, split_metric
from pipeline.output.terminal import (
    print_claims,
    print_json,
    print_metrics,
    print_parameters,
    print_table,
    progress,
    say,
)
from pipeline.runs.executors import pool_for
from pipeline.runs.experiment import (
    Experiment,
    Stated,
    experiment_of_logs,
    read_experiment,
    require_campaign,
    run_experiment,
)
from pipeline.runs.settings import read_settings
from pipeline.runs.sweeps import DRAWN, Sampling, nested, parse_over, points_of, run_sweep
from recorders.errors import BadInput
from recorders.parameters import merge, parse_settings


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
    tells_parameters: bool,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> None:
    """Run an experiment, or replay logs as one, and print its metrics and claims."""
    stated, values = _stated_experiment(named, labels, over, settings_file, settings)
    label, experiment = stated.name, stated.with_settings(values, over)
    if experiment.logs and data is not None and named[0].endswith(".mcap"):
        raise BadInput(f"{named[0]}: logs are replayed as they are; leave out --data")
    if workers is not None or scheduler is not None:
        require_campaign(experiment, "leave out --workers and --scheduler")
    folder = out or Path("out") / label
    inputs = _files_of(named, experiment, settings_file)
    check_folder(folder, {"input": inputs if data is None else [*inputs, data]})
    open_pool = pool_for(workers, scheduler, len(experiment.files) or experiment.runs)
    result = run_experiment(
        label,
        experiment,
        folder,
        data=data,
        logs=logs,
        errors=errors,
        open_pool=open_pool,
        progress=progress,
    )
    if as_json:
        print_json(result.model_dump(mode="json"))
        return
    if tells_parameters:
        print_parameters(result.settings["parameters"])
        say("a parameter of a model that is not listed is taken from the log; see fuselog replay")
    runs = folder / RUNS
    print_metrics(result.metrics, result.bounds, read_table(runs) if runs.is_file() else None)
    print_claims(result.claims)
    say(f"{folder}: {', '.join(result.contents)}")


def _stated_experiment(
    named: Sequence[str],
    labels: Sequence[str],
    over: Mapping[str, Any],
    settings_file: Path | None,
    settings: Sequence[str],
) -> tuple[Stated, dict[str, Any]]:
    """The experiment of a name or a TOML file, or that of logs, and the settings that go over it."""
    files = [Path(each) for each in named if each.endswith(".mcap")]
    if files and (len(files) < len(named) or over.keys() & {"runs", "seed"}):
        raise BadInput(f"{files[0]}: logs are replayed as they are; give logs alone, and -e")
    if not files and (len(named) > 1 or labels):
        raise BadInput(f"{named[0]}: one experiment runs at a time, with its own estimators")
    stated = experiment_of_logs(files, labels) if files else read_experiment(named[0])
    return stated, merge(read_settings(settings_file, stated.labels), parse_settings(settings))


def _files_of(named: Sequence[str], experiment: Experiment, settings_file: Path | None) -> list[Path]:
    """The files that an experiment is read from: its logs, itself, its scenario, its settings."""
    scenario = "" if experiment.record is None else experiment.record.scenario
    tables = [Path(each) for each in (*named, scenario) if each.endswith(".toml")]
    return [*experiment.files, *tables, *filter(None, [settings_file])]


def sweep_named(
    named: Sequence[str],
    labels: Sequence[str],
    over: Mapping[str, Any],
    *,
    swept: Sequence[str],
    samples: int | None,
    sampling: Sampling,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> None:
    """Run an experiment, or replay logs as one, at many points; print its metrics at each."""
    overs = [parse_over(text) for text in swept]
    stated, values = _stated_experiment(named, labels, over, settings_file, settings)
    experiment = stated.with_settings(values, over)
    points = points_of(overs, samples, sampling, experiment.seed)
    at = [stated.with_settings(merge(values, nested(point)), over) for point in points]
    folder = out or Path("out") / f"{stated.name}-sweep"
    check_folder(folder, {"input": _files_of(named, experiment, settings_file)})
    open_pool = pool_for(workers, scheduler, len(points) * (len(experiment.files) or experiment.runs))
    result = run_sweep(stated.name, overs, points, at, folder, open_pool=open_pool, progress=progress)
    if as_json:
        print_json(result.model_dump(mode="json"))
        return
    drawn = {key: value for key, value in result.metrics.items() if split_metric(key)[1] in DRAWN}
    lists = {key: value for key, value in drawn.items() if isinstance(value, list)}
    shown = {key: value for key, value in lists.items() if len({*value}) > 1} or lists
    rows = [
        [*point.values(), *(value[number] for value in shown.values())]
        for number, point in enumerate(points)
    ]
    print_table([*points[0], *shown], rows)
    say(f"{folder}: the table of all metrics, figures, result.json")
