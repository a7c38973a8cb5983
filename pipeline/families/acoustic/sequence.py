"""Study of shots in sequence, which measures the benefits of joint and of robust estimation.

Errors are computed at the last report of each shot. For filters and smoothers, the truth is the
shooter's position at that time; for single-shot solutions, which have no motion model, it is the
position at which the shot was fired. Estimators are compared by the mean of the log RMSE over runs, so
that a lost run has an effect but does not dominate.
"""

from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import errors_named, require_spread
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.intervals import Interval, mean_interval

SINGLE, PLAIN, ROBUST = "single-shot", "not-robust", "student"


class Options(Parameters):
    """The cases of the study.

    Attributes:
        cases: changes to the scenario's parameters, by the name of a case; the first has no faults.
    """

    cases: Annotated[dict[str, dict[str, float]], Field(min_length=1)] = {"clean": {}}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    require_spread(experiment.runs)
    outcome, tables = Outcome(), []
    sources: list[MemorySource] = []
    for case, replayed in Runner(experiment, setting).cases(options.cases):
        tables.append(shot_errors(replayed, list(experiment.estimators)).assign(case=case))
        sources += replayed.sources
    shots = pd.concat(tables, ignore_index=True)
    runs = of_runs(shots)
    for (name, label), rows in runs.groupby(["case", "estimator"], sort=False):
        outcome.metrics |= {
            f"{label}.position_rmse_m.{name}": float(np.exp(np.log(rows["rmse_m"]).mean())),
            f"{label}.median_error_m.{name}": _median(shots, name, label),
            f"{label}.located_share.{name}": float(rows["located"].mean()),
        }
        nees = mean_interval(rows["nees"].dropna())
        outcome.measure(f"{label}.nees_per_component.{name}", nees)
        for other in (SINGLE, PLAIN, ROBUST):
            if other != label and other in experiment.estimators:
                ratio = log_ratio(runs, str(name), str(label), other).rising(np.exp)
                outcome.measure(f"{label}.position_ratio.{other}-{name}", ratio)
    outcome.tables |= {"shots": shots, "runs": runs}
    outcome.figures["shots"] = _chart(shots)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def shot_errors(replayed: Replayed, labels: list[str]) -> pd.DataFrame:
    """Tabulate the error of each estimator at every shot of every run, NaN without an estimate.

    `nees` is per component, for all components that the estimate and the truth have in common.
    """
    tables = []
    for label in labels:
        errors = errors_named(replayed, label)
        for run, source in enumerate(replayed.sources):
            fired, last_ns = shots_of(source)
            own = errors.run == run
            rows = np.searchsorted(errors.time_ns[own], last_ns)
            rows = np.minimum(rows, max(own.sum() - 1, 0))
            there = own.any() & np.isin(last_ns, errors.time_ns[own])
            error, nees = np.full((len(last_ns), 2), np.nan), np.full(len(last_ns), np.nan)
            error[there] = errors.error[own][rows[there], :2]
            nees[there] = errors.nees[own][rows[there]] / len(errors.components)
            if "vx_mps" not in errors.components:  # the estimator has no motion model
                error += positions(source, last_ns) - fired
            table = pd.DataFrame({"shot": np.arange(1, len(last_ns) + 1), "nees": nees})
            tables.append(table.assign(error_m=np.hypot(*error.T), run=run, estimator=label))
    return pd.concat(tables, ignore_index=True)


def shots_of(source: MemorySource) -> tuple[Floats, Any]:
    """Return the firing positions (shots, 2) of shots that were heard, and when each was heard last."""
    detections = [stream for topic, stream in source.streams.items() if topic.endswith("/detections")]
    shot = np.concatenate([stream["shot_id"] for stream in detections]).astype(np.int64)
    heard_ns = np.concatenate([stream.publish_time_ns for stream in detections])
    numbers, places = np.unique(shot, return_inverse=True)
    last_ns = np.zeros(len(numbers), np.int64)
    np.maximum.at(last_ns, places, heard_ns)
    interval_ns = round(source.run.parameters["interval_s"] * 1e9)
    return positions(source, source.epoch_ns + (numbers - 1) * interval_ns), last_ns


def positions(source: MemorySource, time_ns: Any) -> Floats:
    """Return the shooter's positions (n, 2)."""
    truth = source.streams["/shooter/truth"]
    elapsed, known = time_ns - source.epoch_ns, truth.publish_time_ns - source.epoch_ns
    return np.stack([np.interp(elapsed, known, truth["state"][:, axis]) for axis in range(2)], axis=1)


def of_runs(shots: pd.DataFrame) -> pd.DataFrame:
    """Compute every run's RMSE and mean NEES over the located shots, and the share of located shots."""
    grouped = shots.groupby(["case", "estimator", "run"], sort=False)
    return pd.DataFrame(
        {
            "rmse_m": np.sqrt(grouped["error_m"].apply(lambda error: (error**2).mean())),
            "nees": grouped["nees"].mean(),
            "located": grouped["error_m"].apply(lambda error: error.notna().mean()),
        }
    ).reset_index()


def log_ratio(runs: pd.DataFrame, case: str, label: str, other: str) -> Interval:
    """Compute the mean log ratio of two RMSEs, over runs in which both estimators located shots."""
    rmse: Any = runs[runs["case"] == case].pivot_table("rmse_m", "run", "estimator")
    return mean_interval(np.log(rmse[label] / rmse[other]).dropna())


def _median(shots: pd.DataFrame, case: Any, label: Any) -> float:
    return float(shots["error_m"][(shots["case"] == case) & (shots["estimator"] == label)].median())


def _chart(shots: pd.DataFrame) -> Chart:
    """Draw the median error over the runs, shot by shot, one panel per case."""
    panels = []
    for case, of_case in shots.groupby("case", sort=False):
        axis = Axis(label="median error (m)", log=True)
        panel = Panel(x=Axis(label="shot"), y=axis, title=str(case))
        for label, rows in of_case.groupby("estimator", sort=False):
            median = rows.groupby("shot")["error_m"].median()
            panel.series.append(curve(str(label), median.index, median))
        panels.append(panel)
    return Chart(panels=panels, columns=3)


ACOUSTIC_SEQUENCE = Study(
    "shots of a moving shooter, estimated jointly and one by one, with wrong detections",
    study,
    Options,
)
