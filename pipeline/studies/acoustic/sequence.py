"""The study of shots in sequence: what it is worth to take them as one problem, and robustly.

Errors are those at the last report of each shot: of filters and smoothers where the shooter is by then,
of single-shot solutions, which know of no motion, where the shot was fired. Claims are of the mean over
the runs of the logarithm of two estimators' RMSE: a run that is lost counts, but not for all others.
"""

from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field

from pipeline.output.charts import Axis, Chart, Panel, curve
from pipeline.output.claims import Claim, judged
from pipeline.output.results import Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import Replayed
from pipeline.runs.runner import Runner
from pipeline.studies.toolkit.repetitions import Interval, errors_named, mean_interval, require_spread
from recorders.parameters import Parameters
from replay.engine.arrays import Floats
from replay.engine.streams.sources import MemorySource

OWN = "(not in the paper)"
SINGLE, PLAIN, ROBUST = "single-shot", "not-robust", "student"


class Options(Parameters):
    """The cases.

    Attributes:
        cases: what differs in the scenario, by the name of a case; the first has no faults.
    """

    cases: Annotated[dict[str, dict[str, float]], Field(min_length=1)] = {"clean": {}}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
            f"{label}.nees_per_component.{name}": float(rows["nees"].mean()),
            f"{label}.located_share.{name}": float(rows["located"].mean()),
        }
    outcome.claims = claims(runs, list(options.cases))
    outcome.tables |= {"shots": shots, "runs": runs}
    outcome.figures["shots"] = _chart(shots)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def shot_errors(replayed: Replayed, labels: list[str]) -> pd.DataFrame:
    """How far off each estimator is at every shot of every run, NaN where it has no estimate.

    `nees` is per component, of all that an estimator tells and the truth has.
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
            if "vx_mps" not in errors.components:  # knows of no motion
                error += positions(source, last_ns) - fired
            table = pd.DataFrame({"shot": np.arange(1, len(last_ns) + 1), "nees": nees})
            tables.append(table.assign(error_m=np.hypot(*error.T), run=run, estimator=label))
    return pd.concat(tables, ignore_index=True)


def shots_of(source: MemorySource) -> tuple[Floats, Any]:
    """From where each shot was fired that anybody heard (shots, 2), and when it was heard last (ns)."""
    detections = [stream for topic, stream in source.streams.items() if topic.endswith("/detections")]
    shot = np.concatenate([stream["shot_id"] for stream in detections]).astype(np.int64)
    heard_ns = np.concatenate([stream.publish_time_ns for stream in detections])
    numbers, places = np.unique(shot, return_inverse=True)
    last_ns = np.zeros(len(numbers), np.int64)
    np.maximum.at(last_ns, places, heard_ns)
    interval_ns = round(source.run.parameters["interval_s"] * 1e9)
    return positions(source, source.epoch_ns + (numbers - 1) * interval_ns), last_ns


def positions(source: MemorySource, time_ns: Any) -> Floats:
    """Where the shooter is (n, 2)."""
    truth = source.streams["/shooter/truth"]
    elapsed, known = time_ns - source.epoch_ns, truth.publish_time_ns - source.epoch_ns
    return np.stack([np.interp(elapsed, known, truth["state"][:, axis]) for axis in range(2)], axis=1)


def of_runs(shots: pd.DataFrame) -> pd.DataFrame:
    """The RMSE and the mean NEES of every run over the shots that were located, and their share."""
    grouped = shots.groupby(["case", "estimator", "run"], sort=False)
    return pd.DataFrame(
        {
            "rmse_m": np.sqrt(grouped["error_m"].apply(lambda error: (error**2).mean())),
            "nees": grouped["nees"].mean(),
            "located": grouped["error_m"].apply(lambda error: error.notna().mean()),
        }
    ).reset_index()


def claims(runs: pd.DataFrame, cases: list[str]) -> list[Claim]:
    """What was expected before the first run, of the estimators that there are."""
    clean, *faulty = cases
    there = set(runs["estimator"])
    found = []
    if {SINGLE, PLAIN, "smoother"} <= there:
        found += [
            _smaller(
                "clean: a filter of all shots is nearer than single shots", runs, clean, PLAIN, SINGLE
            ),
            _consistent(
                "clean: the filter's covariance is right within a fifth", runs, clean, PLAIN, 1.2
            ),
            _smaller("clean: smoothing takes a fifth off", runs, clean, "smoother", PLAIN, 0.8),
        ]
    if {ROBUST, PLAIN} <= there:
        statement = "clean: a robust filter errs by at most a tenth more than one that trusts all"
        found.append(_smaller(statement, runs, clean, ROBUST, PLAIN, 1.1))
    for case in faulty:
        found += [
            _smaller(f"{case}: {label} errs by less than half of {other}", runs, case, label, other, 0.5)
            for label, other in ((ROBUST, PLAIN), (ROBUST, SINGLE))
            if {label, other} <= there
        ]
        found += [
            _smaller(
                f"{case}: {label} is nearer than the filter that trusts all", runs, case, label, PLAIN
            )
            for label in ("inflated", "ukf", "smoother", "iterated", "mixture")
            if {label, PLAIN} <= there
        ]
        if {"mixture", ROBUST} <= there:
            statement = f"{case}: a mixture for each component is nearer than a heavy tail for all"
            found.append(_smaller(statement, runs, case, "mixture", ROBUST))
        if ROBUST in there:
            statement = f"{case}: the robust filter's covariance is right within a half"
            found.append(_consistent(statement, runs, case, ROBUST, 1.5))
    return found


def log_ratio(runs: pd.DataFrame, case: str, label: str, other: str) -> Interval:
    """The mean logarithm of the ratio of two estimators' RMSE, over the runs that both located."""
    rmse: Any = runs[runs["case"] == case].pivot_table("rmse_m", "run", "estimator")
    return mean_interval(np.log(rmse[label] / rmse[other]).dropna().tolist())


def _smaller(
    statement: str, runs: pd.DataFrame, case: str, label: str, other: str, most: float = 1.0
) -> Claim:
    """A claim that holds where the whole interval of the ratio of RMSEs is below `most`."""
    ratio, low, high = np.exp(log_ratio(runs, case, label, other))
    ours = f"{ratio:.2f} times, 95 % {low:.2f} to {high:.2f}"
    return judged(statement, OWN, ours, high < most)


def _consistent(statement: str, runs: pd.DataFrame, case: str, label: str, most: float) -> Claim:
    """A claim that holds where the whole interval of the mean NEES per component is within a factor."""
    chosen = (runs["case"] == case) & (runs["estimator"] == label)
    mean, low, high = mean_interval(runs["nees"][chosen].dropna().tolist())
    ours = f"NEES per component {mean:.2f}, 95 % {low:.2f} to {high:.2f}"
    return judged(statement, OWN, ours, 1.0 / most < low and high < most)


def _median(shots: pd.DataFrame, case: Any, label: Any) -> float:
    return float(shots["error_m"][(shots["case"] == case) & (shots["estimator"] == label)].median())


def _chart(shots: pd.DataFrame) -> Chart:
    """The median error over the runs, shot by shot, a panel for each case."""
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
    "shots of one moving shooter as one problem, beside single shots, with wrong detections",
    study,
    Options,
)
