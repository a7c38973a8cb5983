"""Summaries of judged replays, with metrics, tables and charts."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.charts import Axis, Chart, Panel, Series, Style, band, curve, thinned
from fuselog.pipeline.output.coverage import coverage_table
from fuselog.pipeline.output.results import MetricValue, Outcome, split_metric
from fuselog.replay.engine.replaying.usage import Row
from fuselog.replay.judging.errors.evaluation import Errors, Floats, nis_by_bin
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.means import INSERTED

if TYPE_CHECKING:
    import pandas as pd

MOST_COLUMNS = 3
BINS = 60


def summarise(
    judge: Judge,
    coverage: Sequence[Row] = (),
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
) -> Outcome:
    """Summarise a judged replay in metrics, warnings, tables, figures and message counts.

    Args:
        judge: judge of all runs.
        coverage: how many messages of each topic were used.
        parameters: parameters of the estimators by label, if known.
    """
    import pandas as pd  # slow to import

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
    if judge.failed_runs:
        outcome.tables["failures"] = pd.DataFrame(judge.failed_runs, columns=["run", "failure"])
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
    """Draw the errors of each case over time, if there are any."""
    steps = {topic: table for topic, table in judge.steps.items() if len(table)}
    judged = {topic: each for topic, each in judge.judged.items() if topic in steps}
    shown: dict[str, list[tuple[Errors, pd.DataFrame]]] = {}
    for topic, errors in judged.items():
        shown.setdefault(errors.case, []).append((errors, steps[topic]))
    return {case: error_chart(each, case) for case, each in shown.items()}


def summary_table(metrics: Mapping[str, MetricValue]) -> "pd.DataFrame":
    """Make a table with a row per metric: estimator, quantity, case, value."""
    import pandas as pd  # slow to import

    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_chart(judged: "list[tuple[Errors, pd.DataFrame]]", case: str) -> Chart:
    """Draw RMSE and NEES over time for all runs together, with the 95 % band of a consistent estimator.

    Each panel shows one estimator, so curves never overlap. The panels of a row share their axes.
    """
    first, table = judged[0]
    named = {
        "position_rmse_m": "position error, RMS (m)",
        "orientation_rmse_deg": "orientation error (°)",
    }
    main = named.get(first.main.rmse, f"error of {first.components[0]}, RMS")
    bounds = [
        curve(errors.estimator, rows["elapsed_s"], rows[errors.main.rmse], "dashed")
        for errors, steps in judged
        if errors.is_bound and len(rows := steps.iloc[thinned(len(steps))])
    ]
    rmse_axis = _log_axis(main, [of for _, of in judged], first.main.rmse)
    nees_axis = _log_axis(
        "mean NEES",
        [of for errors, of in judged if not errors.is_bound],
        "nees",
        "nees_low",
        "nees_high",
    )
    rmse, nees = [], []
    for errors, of_all in judged:
        if errors.is_bound:
            continue
        steps = of_all.iloc[thinned(len(of_all))]
        label, time_s, quantity = errors.estimator, steps["elapsed_s"], errors.main.rmse
        ends = steps[f"{quantity}_low"], steps[f"{quantity}_high"]
        title = _title(label, of_all, quantity, f"{quantity}_low")
        rmse.append(
            panel_over_time(label, time_s, steps[quantity], ends, rmse_axis, title, others=bounds)
        )
        ends, title = (steps["nees_low"], steps["nees_high"]), _title(label, of_all, "nees", "nees_low")
        consistent = f"95 % if consistent ({len(errors.components)} components)"
        nees.append(panel_over_time(label, time_s, steps["nees"], ends, nees_axis, title, consistent))
    runs = int(table["runs"].max())
    what = f"{case or 'errors'}, {'1 run' if runs == 1 else f'over all {runs} runs together'}"
    panels = [*rmse, *nees]
    title = f"{what}; tinted: 95 % range if the estimator's covariance is right"
    return Chart(title=title, panels=panels, columns=max(1, min(len(rmse), MOST_COLUMNS)), legend=False)


def _log_axis(label: str, tables: "Sequence[pd.DataFrame]", *columns: str) -> Axis:
    """Make one logarithmic axis that covers the positive values of all tables."""
    import pandas as pd  # slow to import

    values = pd.concat([table[name] for table in tables for name in columns if name in table])
    positive = values[(values > 0) & (values < float("inf"))]
    if positive.empty:
        return Axis(label=label, log=True)
    low, high = positive.quantile(0.001), positive.max()
    return Axis(label=label, log=True, limits=(float(low) / 1.5, float(high) * 1.2))


def _title(label: str, steps: "pd.DataFrame", quantity: str, low: str) -> str:
    """Write an estimator's name and the share of steps at which the quantity is outside its interval."""
    known = steps[[quantity, low, low.replace("_low", "_high")]].dropna()
    if known.empty:
        return label
    is_out = (known.iloc[:, 0] < known.iloc[:, 1]) | (known.iloc[:, 0] > known.iloc[:, 2])
    share = float(is_out.mean())
    where = (
        "never"
        if not share
        else "always"
        if share == 1.0
        else f"at {100 * max(share, 0.01):.0f} % of steps"
    )
    return f"{label}: outside {where}"


def by_case(table: "pd.DataFrame", draw: "Callable[[pd.DataFrame, str], Chart]") -> dict[str, Chart]:
    """Apply `draw` to the rows of each case, and return the charts."""
    if table.empty:
        return {}
    return {str(case): draw(rows, str(case)) for case, rows in table.groupby("case", sort=False)}


def mode_chart(modes: "pd.DataFrame", case: str) -> Chart:
    """Draw the probability of each mode over time, averaged over all runs, one panel per estimator."""
    x, y = Axis(label="time (s)"), Axis(label="mean probability", limits=(0.0, 1.0))
    panels = {name: Panel(x=x, y=y, title=name) for name in modes["estimator"].unique()}
    for (name, mode, smoothed), rows in modes.groupby(["estimator", "mode", "smoothed"], sort=False):
        style: Style = "dashed" if smoothed else "line"
        series = curve(str(mode), rows["elapsed_s"], rows["probability"], style)
        panels[name].series.append(series)
    dashed = "; dashed: from all data of a run" if modes["smoothed"].any() else ""
    title = f"{case or 'modes'}, probability of each mode{dashed}"
    return Chart(title=title, panels=list(panels.values()))


def effective_chart(effective: "pd.DataFrame", case: str) -> Chart:
    """Draw the effective share of the particles over time, averaged over all runs."""
    x, y = Axis(label="time (s)"), Axis(label="effective share", limits=(0.0, 1.0))
    series = [
        curve(str(name), rows["elapsed_s"], rows["effective_share"])
        for name, rows in effective.groupby("estimator", sort=False)
    ]
    title = f"{case or 'particles'}, effective share of the particles"
    return Chart(title=title, panels=[Panel(x=x, y=y, series=series)])


def late_counts(late: "pd.DataFrame") -> "pd.DataFrame":
    """Count out-of-sequence messages, with a row per estimator, case and outcome; see `Judge.late`.

    Each row contains the mean delay in seconds, and how many messages were reprocessed as a result.
    """
    rows = late.assign(late_s=late["late_s"] * late["messages"])
    if "repeated" in late:
        rows["repeated"] = late["repeated"].fillna(0.0) * late["messages"]
    counts = rows.drop(columns="elapsed_s").groupby(["estimator", "case", "became"], sort=False).sum()
    counts["late_s"] /= counts["messages"]
    return counts.reset_index()


def late_chart(late: "pd.DataFrame", case: str) -> Chart:
    """Draw the delay of out-of-sequence messages over time by their outcome, one panel per estimator."""
    counts, panels = late_counts(late), []
    for name, rows in late.groupby("estimator", sort=False):
        series = [
            curve(str(became), each["elapsed_s"], each["late_s"], "markers")
            for became, each in rows.groupby("became", sort=False)
        ]
        captions = [
            f"{each.messages} {each.became}"
            + (f", {each.repeated:.0f} reprocessed for them" if each.became == INSERTED else "")
            for each in counts[counts["estimator"] == name].itertuples()
        ]
        x, y = Axis(label="time (s)"), Axis(label="mean delay (s)")
        panels.append(Panel(x=x, y=y, series=series, title=f"{name}: {'; '.join(captions)}"))
    return Chart(title=f"{case or 'messages'}, out-of-sequence messages", panels=panels)


def panel_over_time(
    label: str,
    time_s: ArrayLike,
    values: ArrayLike,
    ends: tuple[ArrayLike, ArrayLike],
    y: Axis,
    title: str,
    of_band: str = "",
    others: Sequence[Series] = (),
) -> Panel:
    """Draw values (n,) over a range, with a strip along the bottom that marks where they are outside it.

    Args:
        label: name of the estimator; without `of_band`, also the name of the range.
        time_s: (n,).
        values: (n,).
        ends: the lower and upper ends (n,) of the range.
        y: vertical axis; the strip that marks values outside the range is drawn at the axis's lower
            limit.
        title: text above the panel.
        of_band: name of a range that is the same for all estimators.
        others: further curves.
    """
    is_out = (values < np.asarray(ends[0])) | (values > np.asarray(ends[1]))
    series = [curve(label, time_s, values), *others]
    if is_out.any() and y.limits is not None:
        foot = np.full(int(is_out.sum()), 1.03 * y.limits[0])
        series.append(curve("outside", np.asarray(time_s)[is_out], foot, "outside"))
    shown = band(of_band or label, time_s, *ends, reference=bool(of_band))
    return Panel(x=Axis(label="time (s)"), y=y, series=series, bands=[shown], title=title)


def nis_over_time(
    time_s: Floats, squared: Floats, degrees: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Average NIS per component in `BINS` equal parts of a run.

    Args:
        time_s: (n,), times of the innovations.
        squared: (n,), NIS.
        degrees: (n,), numbers of components of the innovations.

    Returns, for the m parts with innovations, the middle of the part in s, the mean, and the lower and
    the upper end of its 95 % interval, (m,) each.
    """
    width_s = max(float(np.ptp(time_s)) / BINS, 1e-9)
    place = np.minimum(((time_s - time_s.min()) / width_s).astype(np.int64), BINS - 1)
    bins, *nis = nis_by_bin(place, squared, degrees)
    return time_s.min() + (bins + 0.5) * width_s, *nis
