"""Summarises judged replays: metrics, tables, and figures of errors, modes, particles, late messages."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.output.alarming import alarms_of
from pipeline.output.charts import Axis, Chart, Panel, Style, band, curve, thinned
from pipeline.output.coverage import coverage_table
from pipeline.output.results import MetricValue, Outcome, split_metric
from replay.engine.replaying.usage import Row
from replay.judging.errors.evaluation import Errors
from replay.judging.judge import Judge
from replay.judging.metrics.means import INSERTED


def summarise(
    judge: Judge,
    coverage: Sequence[Row] = (),
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
) -> Outcome:
    """Metrics, alarms, tables and figures of a judged replay, and what became of the log's topics in it.

    Args:
        judge: of all runs.
        coverage: what became of the topics.
        parameters: of the estimators by label, as far as they are known.
    """
    outcome = Outcome(alarms=alarms_of(judge, parameters or {}, coverage))
    if coverage:
        outcome.tables["coverage"] = coverage_table(coverage)
    outcome.metrics.update(judge.metrics)
    outcome.bounds.update(judge.bounds)
    outcome.tables["summary"] = summary_table(outcome.metrics)
    steps = [table for table in judge.steps.values() if len(table)]
    if steps:
        outcome.tables["steps"] = pd.concat(steps)
        outcome.tables["runs"] = judge.runs_table
        outcome.tables["times"] = judge.times
    over_time = {"modes": judge.modes, "effective": judge.effective, "late-times": judge.late}
    outcome.tables |= {name: table for name, table in over_time.items() if len(table)}
    if len(judge.late):
        outcome.tables["late"] = late_counts(judge.late)
    drawn = {
        "errors": error_charts(judge),
        "modes": by_case(judge.modes, mode_chart),
        "effective": by_case(judge.effective, effective_chart),
        "late": by_case(judge.late, late_chart),
    }
    for what, charts in drawn.items():
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
    """Return one row per metric: estimator, quantity, case, value."""
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


def by_case(table: pd.DataFrame, draw: Callable[[pd.DataFrame, str], Chart]) -> dict[str, Chart]:
    """A chart of the rows of each case."""
    if table.empty:
        return {}
    return {str(case): draw(rows, str(case)) for case, rows in table.groupby("case", sort=False)}


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


def effective_chart(effective: pd.DataFrame, case: str) -> Chart:
    """The mean share of the particles that is effective over time, all runs together."""
    x, y = Axis(label="time (s)"), Axis(label="effective share", limits=(0.0, 1.0))
    series = [
        curve(str(name), rows["elapsed_s"], rows["effective_share"])
        for name, rows in effective.groupby("estimator", sort=False)
    ]
    title = f"{case or 'particles'}, share of the particles that is effective"
    return Chart(title=title, panels=[Panel(x=x, y=y, series=series)])


def late_counts(late: pd.DataFrame) -> pd.DataFrame:
    """Count late messages: a row per estimator, case and what became of them; see `Judge.late`.

    With their mean delay in seconds, and how many messages were used again for them.
    """
    rows = late.assign(late_s=late["late_s"] * late["messages"])
    if "repeated" in late:
        rows["repeated"] = late["repeated"].fillna(0.0) * late["messages"]
    counts = rows.drop(columns="elapsed_s").groupby(["estimator", "case", "became"], sort=False).sum()
    counts["late_s"] /= counts["messages"]
    return counts.reset_index()


def late_chart(late: pd.DataFrame, case: str) -> Chart:
    """Draw how late messages came over time and what became of them, a panel for each estimator."""
    counts, panels = late_counts(late), []
    for name, rows in late.groupby("estimator", sort=False):
        series = [
            curve(str(became), each["elapsed_s"], each["late_s"], "markers")
            for became, each in rows.groupby("became", sort=False)
        ]
        captions = [
            f"{each.messages} {each.became}"
            + (f", {each.repeated:.0f} used again for them" if each.became == INSERTED else "")
            for each in counts[counts["estimator"] == name].itertuples()
        ]
        x, y = Axis(label="time (s)"), Axis(label="mean delay (s)")
        panels.append(Panel(x=x, y=y, series=series, title=f"{name}: {'; '.join(captions)}"))
    return Chart(title=f"{case or 'messages'}, messages that came late", panels=panels)
