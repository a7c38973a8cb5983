"""A study of the growth of position errors during an outage, by grade of the inertial unit.

The same drives, with an outage in the middle, are recorded with units of several grades. The largest
error of n runs exceeds the q-quantile of the errors with the probability 1 - q^n: 0.95 for 59 runs and
q = 0.95 (Wilks, Annals of Mathematical Statistics 12(1), 1941).
"""

from typing import NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.simulators.navigation_parameters import NavigationParameters
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.errors.evaluation import Errors

AFTER_S = (10.0, 20.0, 30.0)  # times in s since the last fix at which errors are metrics


class Options(Parameters):
    """The grades of inertial units.

    Attributes:
        grades: parameters of the scenario's inertial unit, by grade.
    """

    grades: dict[str, dict[str, float]]


class Span(NamedTuple):
    """The time span of an outage, in s since the epoch of the run."""

    begin_s: float
    end_s: float


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    outcome = Outcome()
    sources: list[MemorySource] = []
    tables: list[pd.DataFrame] = []
    cases = {grade: {"unit": unit} for grade, unit in options.grades.items()}
    for grade, replayed in Runner(experiment, setting).cases(cases):
        span = outage_of(replayed.sources[0])
        tables += [
            horizontal(errors, span).assign(grade=grade, estimator=errors.estimator)
            for errors in replayed.errors
        ]
        sources += replayed.sources
    table = pd.concat(tables)
    largest = table.groupby(["grade", "estimator", "after_s"], sort=False)["error_m"].max().reset_index()
    for grade, estimator, after_s, error_m in largest.itertuples(index=False):
        if after_s in AFTER_S:
            outcome.metrics[f"{estimator}.horizontal_95_m.{grade}-{after_s:g}s"] = float(error_m)
    if not outcome.metrics:
        raise BadInput(
            f"study imu-grades: no estimate {AFTER_S[0]:g} s after the start of the outage; use "
            "a longer outage, such as gnss.outages_s=[[50, 80.5]], and estimates every 0.5 s"
        )
    outcome.input_sha256 = hash_streams(sources)
    outcome.tables["largest"] = largest
    outcome.figures["outage"] = _chart(largest)
    return outcome


def outage_of(source: MemorySource) -> Span:
    """Return the outage of a drive; raise BadInput if it does not have exactly one."""
    given = NavigationParameters.model_validate(source.run.parameters).gnss.outages_s
    if len(given) != 1:
        raise BadInput(
            f"study imu-grades: the scenario has {len(given)} outages; give exactly one, such as "
            "gnss.outages_s=[[50, 80]]"
        )
    return Span(*given[0])


def horizontal(errors: Errors, span: Span) -> pd.DataFrame:
    """Tabulate the horizontal errors (m) during the outage by run and time since its beginning."""
    inside = (errors.elapsed_s >= span.begin_s) & (errors.elapsed_s < span.end_s)
    plane = [errors.components.index(name) for name in ("x_m", "y_m")]
    error_m = np.linalg.norm(errors.error[inside][:, plane], axis=1)
    after_s = np.round(errors.elapsed_s[inside] - span.begin_s, 6)
    return pd.DataFrame({"run": errors.run[inside], "after_s": after_s, "error_m": error_m})


def _chart(largest: pd.DataFrame) -> Chart:
    """Draw the largest error against the time since the last fix, by grade and estimator."""
    panel = Panel(
        x=Axis(label="time since the last fix (s)"),
        y=Axis(label="95 % of drives are within (m)", log=True),
        series=curves(largest, ["grade", "estimator"], "after_s", "error_m"),
    )
    return Chart(panels=[panel])


IMU_GRADES = Study(
    "growth of position errors during an outage, by grade of the inertial unit", study, Options
)
