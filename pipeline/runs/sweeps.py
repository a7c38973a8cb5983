"""Sweeps, which run an experiment at many points of its parameters, on a grid or sampled."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from fuselog.pipeline.altering.changes import is_of_topic
from fuselog.pipeline.output.charts import Axis, Chart, Panel, band, curve
from fuselog.pipeline.output.results import (
    MetricValue,
    Outcome,
    Result,
    result_folder,
    split_metric,
    write_outcome,
)
from fuselog.pipeline.output.words import is_error, label_of
from fuselog.pipeline.runs.campaigns import judge_all
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.ensemble import Pass, Progress, no_progress
from fuselog.pipeline.runs.executors import PoolFactory
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import describe, in_few_words, merge, nested, parse_settings
from fuselog.recorders.recording import Recorder
from fuselog.recorders.registry import load
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import metric_key

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Sampling = Literal["sobol", "random"]
MOST_POINTS = 100_000
# Quantiles that bound the middle 90 % of the runs.
LOW, HIGH = 0.05, 0.95
# Metrics that are drawn; the others are in the table.
MOST_TICKS = 10
DRAWN = ("position_rmse_m", "orientation_rmse_deg", "nees", "position_nees", "nis_per_component")


class Over(NamedTuple):
    """A parameter that is swept.

    Attributes:
        key: the parameter, as in `--set`.
        taken: values on the grid.
        ends: ends of the range from which samples are drawn; None for a list.
        is_log: whether the range is logarithmic.
        name: the parameter's meaning in a few words, if known.
    """

    key: str
    taken: tuple[Any, ...]
    ends: tuple[float, float] | None = None
    is_log: bool = False
    name: str = ""

    @property
    def label(self) -> str:
        """Return the label of the swept parameter's axis."""
        return label_of(self.key, self.name) if self.name else self.key


def parse_over(text: str) -> Over:
    """Parse `KEY=LOW:HIGH:N` (linear), `KEY=LOW:HIGH:logN` (logarithmic) or `KEY=VALUE,VALUE,...`.

    Raises BadInput for anything else.

    >>> parse_over("ekf.sigma_range_m=0.1:10:log3").taken
    (0.1, 1.0, 10.0)
    >>> parse_over("robots=1,2,4").taken
    (1, 2, 4)
    """
    key, _, stated = text.partition("=")
    parts = stated.split(":")
    if len(parts) == 3:
        return _range(text, key, parts)
    return over_of(key, [_value(text, key, each) for each in stated.split(",")])


def over_of(key: str, values: Sequence[Any]) -> Over:
    """Make a swept parameter from a list of values; raise BadInput for duplicates."""
    if len({*map(str, values)}) < len(values) or not values:
        raise BadInput(f"sweep over {key}: give at least one value, and each only once")
    numbers = [each for each in values if isinstance(each, int | float) and each > 0]
    steps = np.diff(np.log(numbers)) if len(numbers) == len(values) > 2 else np.zeros(0)
    is_log = len(steps) > 0 and bool(np.allclose(steps, steps[0]))
    return Over(key, tuple(values), is_log=is_log)


def _range(text: str, key: str, parts: Sequence[str]) -> Over:
    low, high = (_value(text, key, each) for each in parts[:2])
    count = parts[2].removeprefix("log")
    is_log = count != parts[2]
    numbers = all(isinstance(each, int | float) and math.isfinite(each) for each in (low, high))
    if not numbers or not count.isdecimal() or int(count) < 2 or not low < high or (is_log and low <= 0):
        raise BadInput(
            f"--over {text}: expected KEY=LOW:HIGH:N with LOW below HIGH and N at least 2, or logN with "
            "LOW above 0, or a list of values"
        )
    space = np.geomspace if is_log else np.linspace
    values = tuple(float(f"{each:.12g}") for each in space(low, high, int(count)))
    return Over(key, values, (float(low), float(high)), is_log)


def _value(text: str, key: str, stated: str) -> Any:
    if not key or not stated:
        raise BadInput(f"--over {text}: expected KEY=LOW:HIGH:N, KEY=LOW:HIGH:logN or KEY=VALUE,VALUE")
    found: Any = parse_settings([f"value={stated}"])["value"]
    return found


def points_of(
    over: Sequence[Over], samples: int | None = None, sampling: Sampling = "sobol", seed: int = 0
) -> list[dict[str, Any]]:
    """Make the points of a grid, on which the last parameter changes fastest, or samples of the ranges.

    If a parameter has a list instead of a range, a sample contains one of its values. Raises BadInput if
    there are no parameters, or too many points.
    """
    keys = [each.key for each in over]
    if not over or len(set(keys)) < len(keys):
        raise BadInput(
            "a sweep needs at least one parameter, and each only once; give --over KEY=LOW:HIGH:N"
        )
    count = math.prod(len(each.taken) for each in over) if samples is None else samples
    if count > MOST_POINTS:
        raise BadInput(
            f"the sweep has {count} points; at most {MOST_POINTS} are allowed; give fewer values"
        )
    if samples is None:
        return [
            dict(zip(keys, point, strict=True))
            for point in itertools.product(*(each.taken for each in over))
        ]
    rng = np.random.default_rng(seed)
    if sampling == "sobol":
        from scipy.stats import qmc  # slow to import

        sampler = qmc.Sobol(len(over), rng=rng)
        uniform = sampler.random_base2(math.ceil(math.log2(samples)))[:samples]
    else:
        uniform = rng.random((samples, len(over)))
    return [
        {each.key: _at(each, float(share)) for each, share in zip(over, row, strict=True)}
        for row in uniform
    ]


def _at(over: Over, share: float) -> Any:
    """Return the value at a relative position, from 0 to 1, in a range or a list."""
    if over.ends is None:
        return over.taken[min(int(share * len(over.taken)), len(over.taken) - 1)]
    low, high = over.ends
    return low * (high / low) ** share if over.is_log else low + share * (high - low)


def settings_at(point: Mapping[str, Any]) -> dict[str, Any]:
    """Convert keys such as `ekf.sigma_range_m` to nested tables.

    >>> settings_at({"ekf.sigma_range_m": 0.1, "robots": 2})
    {'ekf': {'sigma_range_m': 0.1}, 'robots': 2}
    """
    tables: dict[str, Any] = {}
    for key, value in point.items():
        tables = merge(tables, {key: value} if is_of_topic(key) else nested(key, value))
    return tables


def run_sweep(
    name: str,
    over: Sequence[Over],
    points: Sequence[Mapping[str, Any]],
    experiments: Sequence[Experiment],
    folder: Path,
    *,
    open_pool: PoolFactory | None = None,
    progress: Progress = no_progress,
) -> Result:
    """Run an experiment at every point, and write a result folder; return result.json.

    The metrics in the result are lists with a number for each point; the table has a row for each point.
    Raises BadInput if the study of the experiment does more than replay and judge, or if the experiment
    cannot be run.
    """
    import pandas as pd  # slow to import

    for experiment in experiments:
        if experiment.study != "localization":
            raise BadInput(
                f"{name}: the study {experiment.study} computes more than metrics of single runs; run "
                "the points one by one"
            )
        for label, values in experiment.estimators.items():
            configure(label, values)
    with checkpoints_of(folder) as checkpoints, result_folder(folder) as part:
        setting = Setting(
            part,
            folder,
            logs=0,
            draws=False,
            progress=progress,
            open_pool=open_pool,
            checkpoints=checkpoints,
        )
        outcome = Outcome(kind="sweep")
        tables, errors = [], []
        for number, done in enumerate(judge_all(experiments, setting)):
            tables.append(point_table(number, points[number], done.judge))
            errors.append(errors_of_runs(number, done.judge))
            outcome.parameters = outcome.parameters or done.parameters
        table = pd.concat(tables, ignore_index=True)
        outcome.tables |= {"sweep": table, "sweep-runs": pd.concat(errors, ignore_index=True)}
        over = [each._replace(name=meaning_of(each.key, done, experiments[-1])) for each in over]
        outcome.metrics.update(metrics_of(table, len(points)))
        outcome.figures.update(figures_of(table, over))
        settings = experiments[0].model_dump(mode="json", by_alias=True, exclude_none=True)
        settings["sweep"] = [dict(point) for point in points]
        settings["meanings"] = {each.key: each.name for each in over if each.name}
        return write_outcome(part, name, settings, outcome)


def point_table(number: int, point: Mapping[str, Any], judge: Judge) -> "pd.DataFrame":
    """Tabulate the metrics at a point: the value over all runs and the range of the middle 90 % of runs.

    NEES and NIS also have their expected value, and the 95 % range of a consistent estimator.
    """
    import pandas as pd  # slow to import

    runs, bounds = judge.runs_table, judge.bounds
    sizes = {
        metric_key(each.estimator, name, each.case): float(size)
        for each in judge.judged.values()
        for name, size in (("nees", len(each.components)), ("position_nees", len(each.position)))
    }
    rows = []
    for key, value in judge.metrics.items():
        estimator, quantity, case = split_metric(key)
        low = high = math.nan
        if quantity in runs:
            is_own = (runs["estimator"] == estimator) & (runs["case"] == case)
            low, high = runs.loc[is_own, quantity].quantile([LOW, HIGH])
        keys = {"estimator": estimator, "quantity": quantity, "case": case}
        bound_low, bound_high = bounds.get(key, (math.nan, math.nan))
        aim = sizes.get(key, 1.0) if key in bounds else math.nan
        estimate = {"value": value, "low": low, "high": high}
        consistent = {"aim": aim, "bound_low": bound_low, "bound_high": bound_high}
        rows.append({"point": number, **point, **keys, **estimate, **consistent})
    return pd.DataFrame(rows)


def errors_of_runs(number: int, judge: Judge) -> "pd.DataFrame":
    """Select the errors of every run at a point, so that points can be compared run by run."""
    runs = judge.runs_table
    names = [name for name in ("estimator", "case", "run") if name in runs]
    kept = runs[[*names, *(key for key in runs if is_error(str(key)))]].copy()
    kept.insert(0, "point", number)
    return kept


def meaning_of(key: str, done: Pass, experiment: Experiment) -> str:
    """Describe a parameter of an estimator or scenario in a few words; return "" if it is unknown."""
    for label, words in done.meanings.items():
        name = key.removeprefix(f"{label}.")
        if name in experiment.estimators.get(label, {}):
            return words.get(name, "")
    if experiment.record is None:
        return ""
    recorder = load_scenario(experiment.record.scenario)[0]
    of_scenario = describe(load("recorders", recorder, Recorder).parameters)
    return in_few_words(next((each.meaning for each in of_scenario if each.name == key), ""))


def metrics_of(table: "pd.DataFrame", points: int) -> dict[str, MetricValue]:
    """Collect every metric as a list by point, with NaN for points at which the metric is missing."""
    found: dict[str, MetricValue] = {}
    for names, rows in table.groupby(["estimator", "quantity", "case"], sort=False):
        values = dict(zip(rows["point"], rows["value"], strict=True))
        found[metric_key(*map(str, names))] = [values.get(number, math.nan) for number in range(points)]
    return found


def figures_of(table: "pd.DataFrame", over: Sequence[Over]) -> dict[str, "Chart | Figure"]:
    """Draw each quantity in each case: a heat map if two numeric parameters are swept, else curves."""
    numbers = all(isinstance(value, int | float) for each in over for value in each.taken)
    grid = math.prod(len(each.taken) for each in over) == table["point"].nunique()
    figures: dict[str, Chart | Figure] = {}
    drawn = table[table["quantity"].isin(DRAWN)]
    for (quantity, case), rows in drawn.groupby(["quantity", "case"]):
        name = "-".join(filter(None, (str(quantity), str(case))))
        changes = rows.groupby("estimator")["value"].transform(np.ptp) > 0
        shown = rows[changes] if changes.any() else rows  # constant curves are omitted
        is_map = len(over) == 2 and numbers and grid
        drawn_as = (
            heat_maps(shown, over, name) if is_map else curves(shown, over, str(quantity), str(case))
        )
        figures[name] = drawn_as
    return figures


def curves(rows: "pd.DataFrame", over: Sequence[Over], quantity: str, case: str = "") -> Chart:
    """Draw the quantity over each parameter, averaged over the other swept parameters."""
    panels = []
    for each in over:
        numbers = all(isinstance(value, int | float) for value in each.taken)
        few = numbers and len(each.taken) <= MOST_TICKS
        ticks = {float(value): f"{value:.3g}" for value in each.taken} if few else {}
        x = Axis(label=each.label, log=each.is_log, ticks=ticks)
        panel = Panel(x=x, y=Axis(label=label_of(quantity)))
        for label, own in rows.groupby("estimator", sort=False):
            means = own.groupby(each.key)[["value", "low", "high"]].mean()
            places = means.index.to_numpy()
            panel.series.append(curve(str(label), places, means["value"], "line+markers"))
            if means["low"].notna().any():
                panel.bands.append(band(str(label), places, means["low"], means["high"]))
        panels.append(panel)
    shared = ", means over the others" if len(over) > 1 else ""
    of = f" of {case}" if case else ""
    title = f"{label_of(quantity)}{of}{shared}; bands: middle 90 % of runs"
    return Chart(title=title, panels=panels)


def heat_maps(rows: "pd.DataFrame", over: Sequence[Over], name: str) -> "Figure":
    """Draw the quantity over two parameters, a map per estimator, with a cross at the smallest error."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    labels = list(rows["estimator"].unique())
    figure = Figure(figsize=(4.6 * len(labels), 4.2), layout="constrained")
    positive = rows["value"][rows["value"] > 0]
    scale = LogNorm(positive.min(), positive.max()) if len(positive.unique()) > 1 else None
    y, x = over
    for place, label in enumerate(labels):
        own = rows[rows["estimator"] == label].pivot_table("value", y.key, x.key)
        axes = figure.add_subplot(1, len(labels), place + 1)
        picture = axes.imshow(own.to_numpy(), norm=scale, origin="lower", aspect="auto")
        if "rmse" in name:
            line, column = np.unravel_index(np.nanargmin(own.to_numpy()), own.shape)
            axes.plot(column, line, "x", color="white", markersize=10)
        for axis, places in ((axes.xaxis, own.columns), (axes.yaxis, own.index)):
            shown = range(0, len(places), -(-len(places) // 9))
            axis.set_ticks(list(shown), [f"{places[index]:.3g}" for index in shown])
        axes.tick_params(axis="x", rotation=45)  # at most nine numbers in a row
        axes.set(xlabel=x.label, ylabel=y.label, title=label)
    figure.colorbar(picture, ax=figure.axes, label=label_of(name.partition("-")[0]))
    return figure
