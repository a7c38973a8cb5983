"""Study that compares methods for cooperative vehicles by total error, error bounds and bandwidth.

Source: Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.families.vehicles.cases import (
    TRACK_BYTES,
    Case,
    Floats,
    Scores,
    VehiclesOptions,
    bytes_per_step,
    scores_of,
)
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.replay.families.vehicles.bounds import bounds, exact_total_error


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: VehiclesOptions = setting.options
    if options.reference not in experiment.estimators:
        raise BadInput(
            f"experiment '{experiment.title}': the reference estimator {options.reference} is missing; "
            "add it to [estimators]"
        )
    cases: list[Case] = []
    for name, replayed in Runner(experiment, setting).cases(options.cases):
        scores = scores_of(replayed.sources, replayed.outputs, experiment.estimators, replayed.others)
        sent = bytes_per_step(replayed.sources, experiment.estimators)
        cases.append(Case(name, replayed.sources, scores, sent))
    few = _few(cases[0], options, setting)
    outcome = Outcome()
    outcome.tables["total-errors"] = pd.concat([_table(case.name, case.scores) for case in cases])
    if few:
        outcome.tables["few-runs"] = _table(cases[0].name, few)
    outcome.tables["bounds"] = _table_of_bounds(cases)
    outcome.tables["bandwidth"] = _table_of_bytes(cases)
    outcome.tables["steps"] = pd.concat([_steps(case) for case in cases])
    for case in cases:
        outcome.metrics |= _metrics(case.name, case.scores, options.reference)
        outcome.metrics |= {
            f"{label}.sent_bytes_per_step.{case.name}": value
            for label, value in case.bytes_per_step.items()
        }
        outcome.figures[f"errors-{case.name}"] = _chart(case)
    of_few = f"{cases[0].name}-first-{min(options.few_runs, len(cases[0].sources))}-runs"
    outcome.metrics |= _metrics(of_few, few, options.reference)
    outcome.input_sha256 = hash_streams(source for case in cases for source in case.sources)
    return outcome


def _few(case: Case, options: VehiclesOptions, setting: Setting) -> dict[str, Scores]:
    """Compute the scores of all estimators, including slow ones, in a case's first `few_runs` runs."""
    if not options.few or not options.few_runs:
        return {}
    sources = case.sources[: options.few_runs]
    outputs = replay_in_memory(sources, options.few, progress=setting.progress)
    beside = {label: scores.of_first(len(sources)) for label, scores in case.scores.items()}
    return beside | scores_of(sources, outputs, options.few)


def _table(case: str, scores: Mapping[str, Scores]) -> pd.DataFrame:
    """Tabulate the mean and the median of the total error over the runs."""
    rows = [
        (
            case,
            label,
            len(each.fixed),
            each.failed,
            *(
                _known(average, errors)
                for errors in (each.fixed, each.assigned)
                for average in (np.mean, np.median)
            ),
            _known(np.mean, each.gospa_by_step),
        )
        for label, each in scores.items()
    ]
    names = ["mean_m", "median_m", "assigned_mean_m", "assigned_median_m", "gospa_m"]
    return pd.DataFrame(rows, columns=["case", "estimator", "runs", "failed_runs", *names])


def _known(average: Callable[[Floats], Any], values: Floats) -> float:
    """Average the finite values; return NaN if no value is finite."""
    known = values[np.isfinite(values)]
    return float(average(known)) if len(known) else np.nan


def _metrics(case: str, scores: Mapping[str, Scores], reference: str) -> dict[str, MetricValue]:
    table = _table(case, scores).to_dict("records")
    found: dict[str, MetricValue] = {}
    for row in table:
        label = row["estimator"]
        found[f"{label}.total_error_m.{case}"] = row["mean_m"]
        found[f"{label}.median_total_error_m.{case}"] = row["median_m"]
        found[f"{label}.assigned_total_error_m.{case}"] = row["assigned_mean_m"]
        found[f"{label}.median_assigned_total_error_m.{case}"] = row["assigned_median_m"]
        found[f"{label}.gospa_m.{case}"] = row["gospa_m"]
        found[f"{label}.failed_runs.{case}"] = float(row["failed_runs"])
    if reference in scores:
        for label, each in scores.items():
            share = float((each.fixed < scores[reference].fixed).mean())
            found[f"{label}.share_below_reference.{case}"] = share
    return found


def _table_of_bounds(cases: list[Case]) -> pd.DataFrame:
    """Tabulate the Kalman filter's exact total error, and bounds of steady-state filters, by case."""
    rows = []
    for case in cases:
        given = case.parameters
        count = given.vehicles or len(given.start)
        fix, sensor = given.fix.variance_m2, given.infrastructure.variance_m2
        steps = int(given.duration_s * given.fix.rate_hz)
        exact = exact_total_error(count, fix, steps, stochastic=given.stochastic)
        rows.append((case.name, exact, *bounds(count, fix, sensor, stochastic=given.stochastic)))
    names = ["kalman_exact_m", "topology_bound_m", "free_pose_bound_m", "known_pose_bound_m"]
    return pd.DataFrame(rows, columns=["case", *names])


def _table_of_bytes(cases: list[Case]) -> pd.DataFrame:
    """Tabulate the bytes that each method sends per step, and the bytes needed to send all tracks."""
    rows = [(case.name, label, value) for case in cases for label, value in case.bytes_per_step.items()]
    for case in cases:
        tracks = TRACK_BYTES * _vehicles(case)
        rows.append((case.name, "all states and covariances", float(tracks)))
    return pd.DataFrame(rows, columns=["case", "method", "bytes_per_step"])


def _vehicles(case: Case) -> int:
    return sum(topic.endswith("/prior") for topic in case.sources[0].topics)


def _steps(case: Case) -> pd.DataFrame:
    """Tabulate the joint error of all vehicles, as RMS over the runs, by estimator and step."""
    columns = [
        "case",
        "estimator",
        "step",
        "error_m",
        "assigned_error_m",
        "assigned_median_m",
        "gospa_m",
    ]
    rows = [
        (
            case.name,
            label,
            step + 1,
            np.sqrt(_known(np.mean, scores.fixed_by_step[:, step])),
            np.sqrt(_known(np.mean, scores.assigned_by_step[:, step])),
            np.sqrt(_known(np.median, scores.assigned_by_step[:, step])),
            _known(np.mean, scores.gospa_by_step[:, step]),
        )
        for label, scores in case.scores.items()
        for step in range(scores.fixed_by_step.shape[1])
    ]
    return pd.DataFrame(rows, columns=columns)


def _chart(case: Case) -> Chart:
    """Draw the median joint error of all vehicles by step, with best labels (the paper's Fig. 3)."""
    series = []
    for label, scores in case.scores.items():
        median = np.sqrt(np.nanmedian(scores.assigned_by_step, axis=0))
        series.append(curve(label, np.arange(1, len(median) + 1), median))
    y = Axis(label="median error of all vehicles (m)", limits=(0, 4))
    return Chart(title=case.name, panels=[Panel(x=Axis(label="step"), y=y, series=series)])


VEHICLES = Study(
    "total errors of cooperative vehicles by method, compared with bounds and the paper",
    study,
    VehiclesOptions,
)
