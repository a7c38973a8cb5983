"""Study of the benefit of data association in clutter, with simulated crossing targets.

Every case combines a clutter rate with a detection probability. A run has the same targets, with the
same true trajectories, in all cases.
"""

from itertools import product
from typing import Any

import pandas as pd

from fuselog.pipeline.families.tracking.study import means_of, measure_changes, table_of
from fuselog.pipeline.output.charts import Axis, Chart, Panel, band, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.parameters import Parameters
from fuselog.replay.families.tracking.judging.errors import instants_of
from fuselog.replay.judging.intervals import mean_interval


class CrossingOptions(Parameters):
    """The cases and the comparisons.

    Attributes:
        clutter_per_scan: mean numbers of false detections in a scan.
        detection_probability: probabilities of detection.
        compared: pairs of estimators; the first of each pair is compared with the second.
    """

    clutter_per_scan: tuple[float, ...] = (10.0, 50.0, 100.0)
    detection_probability: tuple[float, ...] = (0.95, 0.8, 0.65)
    compared: list[tuple[str, str]] = []


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    grid = list(product(setting.options.clutter_per_scan, setting.options.detection_probability))
    cases = {
        _case(*point): dict(zip(("clutter_per_scan", "detection_probability"), point, strict=True))
        for point in grid
    }
    outcome, tables = Outcome(), []
    for name, replayed in Runner(experiment, setting).cases(cases):
        runs = {str(run): instants_of(source) for run, source in enumerate(replayed.sources)}
        table = table_of(replayed.outputs, list(experiment.estimators), runs)
        for position, (quantity, value) in enumerate(cases[name].items()):
            table.insert(position, quantity, value)
        for label, of_mean in means_of(table.drop(columns=[*cases[name]])).items():
            outcome.metrics |= {f"{label}.{what}.{name}": value for what, value in of_mean.items()}
        measure_changes(table, setting.options.compared, outcome, name)
        tables.append(table)
    every = pd.concat(tables, ignore_index=True)
    outcome.tables |= {"runs": every, "summary": summary_table(outcome.metrics)}
    outcome.figures["gospa"] = _chart(every)
    _measure_growth(every, setting.options.compared, outcome)
    return outcome


def _case(clutter_per_scan: float, detection_probability: float) -> str:
    return f"clutter-{clutter_per_scan:g}-detection-{100 * detection_probability:g}"


def _chart(every: pd.DataFrame) -> Chart:
    """Draw GOSPA over clutter with 95 % intervals over runs, one panel per detection probability."""
    panels = []
    for probability, of_panel in every.groupby("detection_probability", sort=False):
        panel = Panel(
            x=Axis(label="false detections in a scan"),
            y=Axis(label="mean GOSPA (m)"),
            title=f"probability of detection {probability:g}",
        )
        for label, rows in of_panel.groupby("estimator", sort=False):
            means = rows.groupby("clutter_per_scan")["gospa_m"].apply(list).map(mean_interval)
            mean, low, high, *_ = zip(*means, strict=True)
            panel.series.append(curve(str(label), means.index, mean, "line+markers"))
            panel.bands.append(band(str(label), means.index, low, high))
        panels.append(panel)
    title = "GOSPA (cutoff 20 m) over clutter; bands: 95 % intervals of the mean over the runs"
    return Chart(title=title, panels=panels, columns=3)


def _measure_growth(every: pd.DataFrame, pairs: list[tuple[str, str]], outcome: Outcome) -> None:
    """Measure how much GOSPA differences between estimators grow from the least to the most clutter."""
    for probability, rows in every.groupby("detection_probability", sort=False):
        by_run: Any = rows.pivot_table("gospa_m", "run", ["estimator", "clutter_per_scan"], sort=False)
        for label, other in pairs:
            if {label, other} <= set(rows["estimator"]):
                apart = by_run[label] - by_run[other]
                growth = mean_interval(apart[max(apart)] - apart[min(apart)])
                case = f"{other}-detection-{100 * float(str(probability)):g}"
                outcome.measure(f"{label}.growth_of_change_m.{case}", growth)


CROSSING = Study("associations by clutter and detection probability", study, CrossingOptions)
