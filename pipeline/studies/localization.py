"""The study of estimators that follow a moving thing: errors, consistency, innovations.

It is what most experiments need: record or import, replay, judge, draw. Families with claims of a paper
call `localize` and add their own tables, figures and claims.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pipeline.ensemble import (
    Replayed,
    estimates_metadata,
    hash_streams,
    record_ensemble,
    replay_ensemble,
)
from pipeline.experiment import Experiment, Setting
from pipeline.results import MetricValue, Outcome, split_metric
from recorders.log import LogWriter
from recorders.recording import import_run
from replay.evaluation import (
    Errors,
    accuracy,
    chi_square_interval,
    consistency,
    error_table,
    innovation_metrics,
    step_table,
)
from replay.sources import MemorySource, memory_source
from replay.timeline.show import show


def study(experiment: Experiment, setting: Setting) -> tuple[Outcome, str]:
    """Run the experiment; see `pipeline.experiment.Study`."""
    sources = obtain(experiment, setting)
    replayed = replay_ensemble(
        sources,
        experiment.estimators,
        gap_limit_s=experiment.gap_limit_s,
        progress=setting.progress,
    )
    write_logs(experiment, setting, sources, replayed)
    show(sources[0], replayed.outputs, replayed.errors, save=setting.folder / "timeline.rrd")
    return summarise(replayed), hash_streams(sources)


def obtain(experiment: Experiment, setting: Setting) -> list[MemorySource]:
    """The experiment's runs: simulated, or the one that is imported."""
    if experiment.import_ is not None:
        path = setting.data or Path()
        return [
            memory_source(*import_run(experiment.import_.source, path, experiment.import_.parameters))
        ]
    assert experiment.record is not None
    return record_ensemble(
        experiment.record.scenario,
        experiment.record.parameters,
        experiment.seed,
        experiment.runs,
        setting.progress,
    )


def write_logs(
    experiment: Experiment, setting: Setting, sources: list[MemorySource], replayed: Replayed
) -> None:
    """The logs and estimates of the first runs; the others can be recorded again from the seed."""
    count = min(setting.logs, len(sources))
    for run in setting.progress(range(count), "writing logs", count):
        source = sources[run]
        log = setting.folder / "logs" / f"run-{run:04d}.mcap"
        with LogWriter(log, source.run) as writer:
            writer.write(source.streams.values())
        metadata = estimates_metadata(source, experiment.estimators, f"../logs/{log.name}")
        with LogWriter(setting.folder / "estimates" / log.name, metadata) as writer:
            writer.write([ragged.of_run(run) for ragged in replayed.outputs.values()])


def summarise(replayed: Replayed) -> Outcome:
    """Metrics, tables and figures of a judged replay."""
    outcome = Outcome()
    for errors in replayed.errors:
        if len(errors.nees):
            _add(outcome, errors.estimator, errors.case, accuracy(errors) | consistency(errors))
        missing = {"estimates_without_truth": float(errors.without_truth)}
        _add(outcome, errors.estimator, errors.case, missing)
    for innovations in replayed.innovations:
        _add(outcome, innovations.estimator, innovations.case, innovation_metrics(innovations))
    judged = [errors for errors in replayed.errors if len(errors.nees)]
    outcome.tables["summary"] = summary_table(outcome.metrics)
    if judged:
        outcome.tables["errors"] = pd.concat([error_table(errors) for errors in judged])
        outcome.tables["steps"] = pd.concat([step_table(errors) for errors in judged])
        for case in dict.fromkeys(errors.case for errors in judged):
            name = f"errors-{case.replace('/', '-')}" if case else "errors"
            outcome.figures[name] = error_figure([each for each in judged if each.case == case], case)
    return outcome


def _add(outcome: Outcome, estimator: str, case: str, values: dict[str, float]) -> None:
    for quantity, value in values.items():
        key = f"{estimator}.{quantity}" + (f".{case}" if case else "")
        outcome.metrics[key] = value


def summary_table(metrics: dict[str, MetricValue]) -> pd.DataFrame:
    """One row per metric: estimator, quantity, case, value."""
    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_figure(judged: list[Errors], case: str) -> Figure:
    """Position RMSE, and NEES with its 95 % interval, over time; all runs together."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for errors in judged:
        table = _thinned(step_table(errors))
        above.plot(table["elapsed_s"], table["position_rmse_m"], label=errors.estimator, lw=1)
        below.plot(table["elapsed_s"], table["nees"], label=errors.estimator, lw=1)
    runs = len(np.unique(judged[0].run))
    low, high = chi_square_interval(len(judged[0].components), runs)
    below.axhspan(low, high, color="0.85", zorder=0, label="95 % if consistent")
    above.set(ylabel="position RMSE (m)", title=f"{case or 'errors'}, {runs} runs")
    below.set(ylabel="mean NEES", xlabel="time (s)", yscale="log")
    above.legend(loc="upper left")
    below.legend(loc="upper left")
    return figure


def _thinned(table: pd.DataFrame, points: int = 2000) -> pd.DataFrame:
    """Every k-th row, so that a figure has no more points than a person sees."""
    return table.iloc[:: max(1, len(table) // points)]
