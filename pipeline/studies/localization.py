"""The study of estimators that follow a moving thing: errors, consistency, innovations.

It is what most experiments need: record or import, replay, judge, draw. Families with claims of a paper
call `localize` and add their own tables, figures and claims.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pipeline.ensemble import (
    Replayed,
    estimates_metadata,
    hash_streams,
    record_ensemble,
    replay_ensemble,
)
from pipeline.experiment import Experiment, Setting, Study, load_scenario
from pipeline.results import MetricValue, Outcome, split_metric
from recorders.errors import BadInput, printable
from recorders.log import LogWriter
from recorders.parameters import merge
from recorders.recording import import_run
from replay.engine.sources import MemorySource, memory_source
from replay.judging.evaluation import Errors, chi_square_interval, error_table, step_table
from replay.judging.metrics import find_metrics, measure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.experiment.Study`."""
    sources, replayed = replay_runs(experiment, setting)
    outcome = summarise(replayed, experiment.metrics)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def replay_runs(experiment: Experiment, setting: Setting) -> tuple[list[MemorySource], Replayed]:
    """The experiment's runs, and what its estimators make of them.

    Writes logs and estimates of the first runs, and the first run's timeline.
    """
    from replay.timeline.show import show

    sources = obtain(experiment, setting)
    replayed = replay_ensemble(
        sources, experiment.estimators, gap_limit_s=experiment.gap_limit_s, progress=setting.progress
    )
    write_logs(experiment, setting, sources, replayed)
    show(sources[0], replayed.outputs, replayed.errors, save=setting.folder / "timeline.rrd")
    return sources, replayed


def obtain(experiment: Experiment, setting: Setting) -> list[MemorySource]:
    """The experiment's runs: simulated, or the one that is imported."""
    if experiment.import_ and setting.data:
        imported = import_run(experiment.import_.source, setting.data, experiment.import_.parameters)
        return [memory_source(*imported)]
    if not experiment.record:
        raise BadInput(f"experiment '{experiment.title}': give what to [record] or to [import]")
    recorder, values, _ = load_scenario(experiment.record.scenario)
    parameters = merge(values, experiment.record.parameters)
    return record_ensemble(recorder, parameters, experiment.seed, experiment.runs, setting.progress)


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
        estimates = setting.folder / "estimates" / log.name
        metadata = estimates_metadata(source, experiment.estimators, estimates, log)
        with LogWriter(estimates, metadata) as writer:
            writer.write([ragged.of_run(run) for ragged in replayed.outputs.values()])


def summarise(replayed: Replayed, metrics: Sequence[str] = ()) -> Outcome:
    """Metrics (all, where none is named), tables and figures of a judged replay."""
    outcome = Outcome()
    outcome.metrics.update(measure(replayed.judged, find_metrics(metrics)))
    outcome.tables["summary"] = summary_table(outcome.metrics)
    judged = [errors for errors in replayed.errors if len(errors.nees)]
    if judged:
        outcome.tables["errors"] = pd.concat([error_table(errors) for errors in judged])
        outcome.tables["steps"] = pd.concat([step_table(errors) for errors in judged])
        for case in dict.fromkeys(errors.case for errors in judged):
            name = f"errors-{case}" if case else "errors"
            outcome.figures[name] = error_figure([each for each in judged if each.case == case], case)
    return outcome


def summary_table(metrics: Mapping[str, MetricValue]) -> pd.DataFrame:
    """One row per metric: estimator, quantity, case, value."""
    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_figure(judged: list[Errors], case: str) -> "Figure":
    """RMSE, and NEES with its 95 % interval, over time; all runs together."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    quantity, label = _main_quantity(judged[0])
    for errors in judged:
        table = _thinned(step_table(errors))
        above.plot(table["elapsed_s"], table[quantity], label=errors.estimator, lw=1)
        below.plot(table["elapsed_s"], table["nees"], label=errors.estimator, lw=1)
    runs = len(np.unique(judged[0].run))
    low, high = chi_square_interval(len(judged[0].components), runs)
    below.axhspan(low, high, color="0.85", zorder=0, label="95 % if consistent")
    title = printable(case or "errors").replace("$", r"\$")  # which starts a formula
    above.set(ylabel=label, title=f"{title}, {runs} {'run' if runs == 1 else 'runs'}")
    below.set(ylabel="mean NEES", xlabel="time (s)", yscale="log")
    above.legend(loc="upper left")
    below.legend(loc="upper left")
    return figure


def _main_quantity(errors: Errors) -> tuple[str, str]:
    """The column of the step table to draw, and what to call it: position, else the first component."""
    if errors.position:
        return "position_rmse_m", "position RMSE (m)"
    return f"rmse_{errors.components[0]}", f"RMSE {errors.components[0]}"


def _thinned(table: pd.DataFrame, points: int = 2000) -> pd.DataFrame:
    """Every k-th row, so that a figure has no more points than a person sees."""
    return table.iloc[:: max(1, len(table) // points)]


LOCALIZATION = Study("errors, consistency and innovations of estimators, over time and runs", study)
