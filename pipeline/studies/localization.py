"""The study of estimators that follow a moving thing: errors, consistency, innovations.

It is what most experiments need: record or import, replay, judge, draw. Families with claims of a paper
add their own tables, figures and claims.
"""

from collections.abc import Mapping

import pandas as pd

from pipeline.campaigns import judge
from pipeline.charts import Axis, Chart, Panel, Style, band, curve, thinned
from pipeline.experiment import Experiment, Setting, Study
from pipeline.results import MetricValue, Outcome, split_metric
from replay.judging.evaluation import Errors
from replay.judging.judge import Judge


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.experiment.Study`."""
    done = judge(experiment, setting)
    outcome = summarise(done.judge)
    outcome.input_sha256, outcome.parameters = done.input_sha256, done.parameters
    return outcome


def summarise(judge: Judge) -> Outcome:
    """Metrics, tables and figures of a judged replay."""
    outcome = Outcome()
    outcome.metrics.update(judge.metrics)
    outcome.bounds.update(judge.bounds)
    outcome.tables["summary"] = summary_table(outcome.metrics)
    steps = [table for table in judge.steps.values() if len(table)]
    if steps:
        outcome.tables["steps"] = pd.concat(steps)
        outcome.tables["runs"] = judge.runs_table
        outcome.tables["times"] = judge.times
    modes = judge.modes
    if len(modes):
        outcome.tables["modes"] = modes
    for what, charts in {"errors": error_charts(judge), "modes": mode_charts(modes)}.items():
        for case, chart in charts.items():
            outcome.figures[f"{what}-{case}" if case else what] = chart
    return outcome


def error_charts(judge: Judge) -> dict[str, Chart]:
    """The errors of each case over time, where there are any."""
    steps = {topic: table for topic, table in judge.steps.items() if len(table)}
    judged = {topic: each for topic, each in judge.judged.items() if topic in steps}
    shown: dict[str, list[tuple[Errors, pd.DataFrame]]] = {}
    for topic, errors in judged.items():
        shown.setdefault(errors.case, []).append((errors, steps[topic]))
    return {case: error_chart(each, case) for case, each in shown.items()}


def summary_table(metrics: Mapping[str, MetricValue]) -> pd.DataFrame:
    """One row per metric: estimator, quantity, case, value."""
    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_chart(judged: list[tuple[Errors, pd.DataFrame]], case: str) -> Chart:
    """RMSE and NEES over time, all runs together, and where each lies with 95 % if consistent."""
    first, table = judged[0]
    named = {"position_rmse_m": "position RMSE (m)", "orientation_rmse_deg": "orientation RMSE (deg)"}
    main = named.get(first.main.rmse, f"RMSE {first.components[0]}")
    rmse = Panel(x=Axis(label="time (s)"), y=Axis(label=main, log=True))
    nees = Panel(x=Axis(label="time (s)"), y=Axis(label="mean NEES", log=True))
    for errors, of_all in judged:
        steps = of_all.iloc[thinned(len(of_all))]
        label, time_s, quantity = errors.estimator, steps["elapsed_s"], errors.main.rmse
        rmse.series.append(curve(label, time_s, steps[quantity]))
        if errors.is_bound:
            continue
        rmse.bands.append(band(label, time_s, steps[f"{quantity}_low"], steps[f"{quantity}_high"]))
        nees.series.append(curve(label, time_s, steps["nees"]))
        consistent = f"95 % if consistent ({len(errors.components)} components)"
        if consistent not in {each.label for each in nees.bands}:
            interval = steps["nees_low"], steps["nees_high"]
            nees.bands.append(band(consistent, time_s, *interval, reference=True))
    runs = int(table["runs"].max())
    what = f"{case or 'errors'}, {runs} {'run' if runs == 1 else 'runs'}"
    return Chart(title=f"{what}; bands: the RMSE's 95 % if consistent", panels=[rmse, nees])


def mode_charts(modes: pd.DataFrame) -> dict[str, Chart]:
    """How probable modes are over time, by case, where there are any; see `Judge.modes`."""
    if modes.empty:
        return {}
    return {str(case): mode_chart(each, str(case)) for case, each in modes.groupby("case", sort=False)}


def mode_chart(modes: pd.DataFrame, case: str) -> Chart:
    """The mean probability of each mode over time, all runs together, a panel for each estimator."""
    x, y = Axis(label="time (s)"), Axis(label="mean probability", limits=(0.0, 1.0))
    panels = {name: Panel(x=x, y=y, title=name) for name in modes["estimator"].unique()}
    for (name, mode, smoothed), rows in modes.groupby(["estimator", "mode", "smoothed"], sort=False):
        style: Style = "dashed" if smoothed else "line"
        series = curve(str(mode), rows["elapsed_s"], rows["probability"], style)
        panels[name].series.append(series)
    dashed = "; dashed: given all data of a run" if modes["smoothed"].any() else ""
    title = f"{case or 'modes'}, probability of each mode{dashed}"
    return Chart(title=title, panels=list(panels.values()))


LOCALIZATION = Study("errors, consistency and innovations of estimators, over time and runs", study)
