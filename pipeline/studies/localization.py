"""The study of estimators that follow a moving thing: errors, consistency, innovations.

It is what most experiments need: record or import, replay, judge, draw. Families with claims of a paper
add their own tables, figures and claims.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import pandas as pd

from pipeline.experiment import Experiment, Setting, Study
from pipeline.results import MetricValue, Outcome, split_metric
from pipeline.runner import Runner
from recorders.errors import printable
from replay.judging.evaluation import Errors, chi_square_interval
from replay.judging.judge import Judge

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.experiment.Study`."""
    judge, input_sha256 = Runner(experiment, setting).judge()
    outcome = summarise(judge)
    outcome.input_sha256 = input_sha256
    return outcome


def summarise(judge: Judge) -> Outcome:
    """Metrics, tables and figures of a judged replay."""
    outcome = Outcome()
    outcome.metrics.update(judge.metrics)
    outcome.tables["summary"] = summary_table(outcome.metrics)
    steps = [table for table in judge.steps.values() if len(table)]
    if steps:
        outcome.tables["steps"] = pd.concat(steps)
        outcome.tables["runs"] = judge.runs_table
        outcome.tables["times"] = judge.times
        for case, figure in error_figures(judge).items():
            outcome.figures[f"errors-{case}" if case else "errors"] = figure
    return outcome


def error_figures(judge: Judge) -> dict[str, "Figure"]:
    """The errors of each case over time, where there are any."""
    steps = {topic: table for topic, table in judge.steps.items() if len(table)}
    judged = {topic: each for topic, each in judge.judged.items() if topic in steps}
    shown: dict[str, list[tuple[Errors, pd.DataFrame]]] = {}
    for topic, errors in judged.items():
        shown.setdefault(errors.case, []).append((errors, steps[topic]))
    return {case: error_figure(each, case) for case, each in shown.items()}


def summary_table(metrics: Mapping[str, MetricValue]) -> pd.DataFrame:
    """One row per metric: estimator, quantity, case, value."""
    rows = [(*split_metric(key), value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["estimator", "quantity", "case", "value"])


def error_figure(judged: list[tuple[Errors, pd.DataFrame]], case: str) -> "Figure":
    """RMSE, and NEES with its 95 % interval, over time; all runs together."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    first, steps = judged[0]
    quantity, label = _main_quantity(first)
    for errors, table in judged:
        shown = _thinned(table)
        above.plot(shown["elapsed_s"], shown[quantity], label=errors.estimator, lw=1)
        below.plot(shown["elapsed_s"], shown["nees"], label=errors.estimator, lw=1)
    runs = int(steps["runs"].max())
    low, high = chi_square_interval(len(first.components), runs)
    below.axhspan(low, high, color="0.85", zorder=0, label="95 % if consistent")
    title = printable(case or "errors").replace("$", r"\$")  # which starts a formula
    above.set(ylabel=label, title=f"{title}, {runs} {'run' if runs == 1 else 'runs'}")
    below.set(ylabel="mean NEES", xlabel="time (s)", yscale="log")
    above.legend(loc="upper left")
    below.legend(loc="upper left")
    return figure


def _main_quantity(errors: Errors) -> tuple[str, str]:
    """The column of the step table to draw, and what to call it: position, else the first component."""
    if errors.position:
        return "position_rmse_m", "position RMSE (m)"
    return f"rmse_{errors.components[0]}", f"RMSE {errors.components[0]}"


def _thinned(table: pd.DataFrame, points: int = 2000) -> pd.DataFrame:
    """Every k-th row, so that a figure has no more points than a person sees."""
    return table.iloc[:: max(1, len(table) // points)]


LOCALIZATION = Study("errors, consistency and innovations of estimators, over time and runs", study)
