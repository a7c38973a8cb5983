"""The study of estimators that follow a moving thing: errors, consistency, innovations.

It is what most experiments need: record or import, replay, judge, draw. Families with claims of a paper
call `localize` and add their own tables, figures and claims.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from pipeline.charts import Axis, Chart, Panel, band, curve, thinned
from pipeline.ensemble import (
    Replayed,
    estimates_metadata,
    hash_streams,
    record_ensemble,
    replay_ensemble,
)
from pipeline.experiment import Experiment, Setting, Study, load_scenario
from pipeline.results import MetricValue, Outcome, split_metric
from recorders.errors import BadInput
from recorders.log import LogWriter
from recorders.parameters import merge
from recorders.recording import import_run
from replay.engine.sources import MemorySource, memory_source
from replay.judging.evaluation import Errors, error_table, rmse_interval, step_table
from replay.judging.metrics import consistency_bounds, find_metrics, measure


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
    outcome.bounds.update(consistency_bounds(replayed.judged))
    outcome.tables["summary"] = summary_table(outcome.metrics)
    judged = [errors for errors in replayed.errors if len(errors.nees)]
    if judged:
        outcome.tables["errors"] = pd.concat([error_table(errors) for errors in judged])
        outcome.tables["steps"] = pd.concat([step_table(errors) for errors in judged])
        for case in dict.fromkeys(errors.case for errors in judged):
            name = f"errors-{case}" if case else "errors"
            outcome.figures[name] = error_chart([each for each in judged if each.case == case], case)
    return outcome


def summary_table(metrics: Mapping[str, MetricValue]) -> pd.DataFrame:
    """One row per metric: estimator, quantity, case, value."""
    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_chart(judged: list[Errors], case: str) -> Chart:
    """RMSE and NEES over time, all runs together, and where each lies with 95 % if consistent."""
    main = _main_quantity(judged[0])
    rmse = Panel(x=Axis(label="time (s)"), y=Axis(label=main.label, log=True))
    nees = Panel(x=Axis(label="time (s)"), y=Axis(label="mean NEES", log=True))
    for errors in judged:
        table = step_table(errors)
        rows = thinned(len(table))
        steps, label = table.iloc[rows], errors.estimator
        time_s, quantity = steps["elapsed_s"], _main_quantity(errors)
        low, high = (quantity.scale * bound[rows] for bound in rmse_interval(errors, quantity.columns))
        rmse.bands.append(band(label, time_s, low, high))
        rmse.series.append(curve(label, time_s, steps[quantity.name]))
        nees.series.append(curve(label, time_s, steps["nees"]))
        consistent = f"95 % if consistent ({len(errors.components)} components)"
        if consistent not in {each.label for each in nees.bands}:
            interval = steps["nees_low"], steps["nees_high"]
            nees.bands.append(band(consistent, time_s, *interval, reference=True))
    runs = len(np.unique(judged[0].run))
    what = f"{case or 'errors'}, {runs} {'run' if runs == 1 else 'runs'}"
    return Chart(title=f"{what}; bands: the RMSE's 95 % if consistent", panels=[rmse, nees])


class Quantity(NamedTuple):
    """What of the errors is drawn: its name in the step table, its label, its columns, their scale."""

    name: str
    label: str
    columns: list[int]
    scale: float = 1.0


def _main_quantity(errors: Errors) -> Quantity:
    """Position, else orientation, else the first component."""
    if errors.position:
        return Quantity("position_rmse_m", "position RMSE (m)", errors.position)
    if errors.rotation:
        label = "orientation RMSE (deg)"
        return Quantity("orientation_rmse_deg", label, errors.rotation, float(np.degrees(1)))
    name = errors.components[0]
    return Quantity(f"rmse_{name}", f"RMSE {name}", [0])


LOCALIZATION = Study("errors, consistency and innovations of estimators, over time and runs", study)
