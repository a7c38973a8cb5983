"""A study of how well maximum likelihood finds the values with which a scenario was recorded.

Every run is tuned separately, for several durations, from the settings of the experiment's only
estimator. The tuning does not know the true values. The study measures how often 95 % intervals cover
the truth, how large the errors of the values are, and how often the notes report that the logs determine
too little.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from pydantic import PositiveFloat

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.tuning.tuning import tune
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource

COVERAGE = 0.95


class TuningOptions(Parameters):
    """Options of the study: the logs' durations, and the free parameters.

    Attributes:
        durations_s: durations of the logs, in s.
        true: the value of each parameter in the recording, by name; these parameters are searched for.
    """

    durations_s: tuple[PositiveFloat, ...] = (20.0, 60.0, 300.0)
    true: dict[str, PositiveFloat] = {}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: TuningOptions = setting.options
    if not options.true or len(experiment.estimators) != 1:
        raise BadInput(f"experiment '{experiment.title}': give one estimator, and [options.true]")
    [(label, settings)] = experiment.estimators.items()
    runner, sources = Runner(experiment, setting), []
    rows: list[dict[str, Any]] = []
    for duration_s in options.durations_s:
        recorded = runner.obtain({"duration_s": duration_s})
        title = f"tuning over {duration_s:g} s"
        for run, source in enumerate(setting.progress(recorded, title, len(recorded))):
            found = _rows(source, label, settings, options.true)
            rows += [{"duration_s": duration_s, "run": run, **row} for row in found]
        sources += recorded
    tuned = pd.DataFrame(rows)
    summary = tuned.groupby(["duration_s", "parameter"], sort=False).apply(_summary).reset_index()
    outcome = Outcome(tables={"tuned": tuned, "lengths": summary}, figures={"lengths": _chart(summary)})
    for row in summary.to_dict("records"):
        case = f"{row['parameter']}-{row['duration_s']:g}s"
        for quantity in ("covered_share", "ratio_spread", "standard_error", "doubtful_share"):
            outcome.metrics[f"{label}.{quantity}.{case}"] = row[quantity]
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _rows(
    source: MemorySource, label: str, settings: Mapping[str, Any], true: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Tune on a log; return a row per parameter: true and tuned value, interval, error, doubt."""
    found = tune(source, {label: settings}, list(true))
    tables, errors = found.parameters.to_dict("records"), found.standard_errors
    return [
        {
            "parameter": row["parameter"],
            "true": true[row["parameter"]],
            "value": row["value"],
            "low": row["low"],
            "high": row["high"],
            "standard_error": error,
            "is_covered": row["low"] <= true[row["parameter"]] <= row["high"],
            "is_doubtful": any(row["parameter"] in note for note in found.notes_of_search),
        }
        for row, error in zip(tables, errors, strict=True)
    ]


def _summary(rows: pd.DataFrame) -> pd.Series:
    """Summarise runs: coverage, the spread of log(value / true), its standard error, doubts."""
    ratios = np.log(rows["value"] / rows["true"])
    return pd.Series(
        {
            "covered_share": rows["is_covered"].mean(),
            "ratio_spread": np.sqrt(np.mean(ratios**2)),
            "standard_error": rows["standard_error"].median(),
            "doubtful_share": rows["is_doubtful"].mean(),
        }
    )


def _chart(summary: pd.DataFrame) -> Chart:
    """Draw coverage and the spread of values with their standard errors against the logs' duration."""
    x = Axis(label="duration of the log (s)", log=True)
    covered = Panel(x=x, y=Axis(label="95 % intervals that cover the truth", limits=(0.0, 1.05)))
    spread = Panel(x=x, y=Axis(label="spread of log(value / true)", log=True))
    for name, rows in summary.groupby("parameter", sort=False):
        length_s = rows["duration_s"]
        covered.series.append(curve(str(name), length_s, rows["covered_share"], "line+markers"))
        spread.series.append(curve(str(name), length_s, rows["ratio_spread"], "line+markers"))
        standard_error = rows["standard_error"]
        spread.series.append(curve(f"{name}, standard error", length_s, standard_error, "dashed"))
    covered.series.append(level("95 %", summary["duration_s"], COVERAGE))
    return Chart(title="tuned values against the duration of the log", panels=[covered, spread])


TUNING = Study(
    "how well maximum likelihood finds the noise that logs were recorded with", study, TuningOptions
)
