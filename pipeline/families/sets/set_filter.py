"""Study of guaranteed sets over time: area, containment, benefit of the past, isolation of faults.

Estimators are compared on the frames in which all of them have a set or an ellipse. Intervals are over
the robots.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd

from fuselog.pipeline.families.sets.error_bounds import BoundOptions, state_bounds
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.replay.engine import chi2
from fuselog.replay.families.sets.judging.evaluation import JudgedSets, judge_sets
from fuselog.replay.families.sets.judging.filter_evaluation import JudgedFilter, judge_filter
from fuselog.replay.families.sets.regions.frames import (
    CONTRADICTS_ITSELF,
    CONTRADICTS_PAST,
    FRAME_WRONG,
    PAST_WRONG,
    UNDECIDED,
)
from fuselog.replay.judging.errors.evaluation import Errors
from fuselog.replay.judging.intervals import mean_interval

ELLIPSE = 0.99
FRAMES, FILTER, L8, EKF, BEARINGS = "frames", "filter", "filter-l8", "ekf", "ekf-bearings"
KEYS = ["case", "run", "time_ns"]
# fewest robots for an interval of the mean share; `set-filter` has no more over all its runs
FEWEST_ROBOTS = 3


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    runner, gap_limit_s = Runner(experiment, setting), experiment.gap_limit_s
    sources = state_bounds(runner.obtain(), setting.options, gap_limit_s)
    replayed = runner.replay(sources)
    runner.keep(sources, replayed.outputs)
    filters = judge_filter(replayed.outputs, sources, gap_limit_s)
    sets = judge_sets(replayed.outputs, sources, gap_limit_s)
    ellipses = [each for each in replayed.errors if set(each.kinds) == {"linear", "angle"}]
    rows = [_set_rows(each) for each in sets] + [_ellipse_rows(each, sets) for each in ellipses]
    table = compared(pd.concat(rows, ignore_index=True))
    summary = summarise(table)
    outcome = Outcome(tables={"frames": table, "robots": summary})
    for row in summary.to_dict("records"):
        key = f"{row['estimator']}.{{}}.{row['case']}" + (f"-run{row['run']}" if row["run"] else "")
        outcome.metrics[key.format("area_median_m2")] = row["area_m2"]
        outcome.metrics[key.format("containment_share")] = row["inside"]
    outcome.metrics |= filter_metrics(filters)
    _compare(summary, outcome)
    of_filter = [each for each in filters if each.sets.estimator == FILTER]
    shares = [float(each.guaranteed[each.sets.known].mean()) for each in of_filter]
    if shares:
        outcome.measure(f"{FILTER}.guaranteed_share", mean_interval(shares, FEWEST_ROBOTS))
    outcome.metrics |= isolation_metrics(filters)
    outcome.figures["sets"] = _chart(summary)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _set_rows(found: JudgedSets) -> pd.DataFrame:
    """Tabulate the sets of one estimator and robot while the truth is known."""
    columns = {
        "estimator": found.estimator,
        "case": found.case,
        "run": found.run,
        "time_ns": found.time_ns,
        "area_m2": found.area_m2,
        "inside": found.inside,
    }
    return pd.DataFrame(columns)[found.known]


def _ellipse_rows(errors: Errors, sets: Sequence[JudgedSets]) -> pd.DataFrame:
    """Tabulate the last ellipse of one estimator and robot at each stamp of the sets."""
    squared_radius = float(chi2.ppf(ELLIPSE, 2))
    place = errors.position
    error, covariance = errors.error[:, place], errors.covariance[:, place][:, :, place]
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    estimated = pd.DataFrame(
        {
            "run": errors.run,
            "time_ns": errors.time_ns,
            "area_m2": np.pi * squared_radius * np.sqrt(np.linalg.det(covariance)),
            "inside": squared <= squared_radius,
        }
    )
    stamps = [
        pd.DataFrame({"run": each.run, "time_ns": each.time_ns})
        for each in sets
        if each.case == errors.case
    ]
    wanted = pd.concat(stamps).drop_duplicates().sort_values("time_ns")
    rows = pd.merge_asof(wanted, estimated.sort_values("time_ns"), on="time_ns", by="run").dropna()
    return rows.assign(estimator=errors.estimator, case=errors.case, inside=rows["inside"].astype(bool))


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Select the frames for which every estimator has a row."""
    count = table.groupby(KEYS)["estimator"].transform("nunique")
    return table[count == table["estimator"].nunique()].reset_index(drop=True)


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Compute the median nonempty area and the share of sets that contain the truth by robot and run."""
    there = table.assign(area_m2=table["area_m2"].where(table["area_m2"] > 0.0))
    groups = there.groupby(["estimator", "case", "run"], sort=False)
    return groups.agg(area_m2=("area_m2", "median"), inside=("inside", "mean")).reset_index()


def filter_metrics(found: Sequence[JudgedFilter]) -> dict[str, MetricValue]:
    """Measure violations of assumptions, and detected faults, by filter and robot."""
    metrics: dict[str, MetricValue] = {}
    for each in found:
        known = each.sets.known
        values = {
            "frames": known.sum(),
            "violations": each.violations,
            "guaranteed": each.guaranteed.sum(),
            "guaranteed_share": each.guaranteed[known].mean(),
            "frames_beyond_bounds": (known & ~each.frame_holds).sum(),
            "odometry_beyond_bounds": (known & ~each.odometry_holds).sum(),
            "outside_arena": each.sets.outside_arena,
            "l8_growth_mean": each.growth[each.growth > 1.0].mean()
            if (each.growth > 1.0).any()
            else 1.0,
            "contradict_themselves": (each.finding == CONTRADICTS_ITSELF).sum(),
            "contradict_the_past": np.isin(each.finding, [CONTRADICTS_PAST, UNDECIDED]).sum(),
            "frame_isolated": (each.finding == FRAME_WRONG).sum(),
            "past_isolated": (each.finding == PAST_WRONG).sum(),
        }
        for name, value in values.items():
            metrics[f"{each.sets.estimator}.{name}.{each.sets.case}"] = float(value)
    return metrics


def _compare(summary: pd.DataFrame, outcome: Outcome) -> None:
    """Measure the filter's areas and containment relative to those of the other estimators."""
    wide = summary.pivot_table(index=["case", "run"], columns="estimator")
    area, inside = wide["area_m2"], wide["inside"]
    for other in (FRAMES, L8, EKF, BEARINGS):
        if {other, FILTER} <= set(area):
            ratio = mean_interval(np.log(area[FILTER] / area[other]))
            outcome.measure(f"{FILTER}.area_ratio.{other}", ratio.rising(np.exp))
            more = mean_interval(inside[FILTER] - inside[other])
            outcome.measure(f"{FILTER}.containment_gain.{other}", more)


def isolation_metrics(filters: Sequence[JudgedFilter]) -> dict[str, MetricValue]:
    """Count right, wrong and missing decisions of a filter between a faulty frame and a faulty past."""
    counts: dict[str, Counter[str]] = {}
    for each in filters:
        count = counts.setdefault(each.sets.estimator, Counter())
        doubted = -1
        for step, finding in enumerate(each.finding.tolist()):
            if finding in (CONTRADICTS_PAST, UNDECIDED):
                count["undecided"] += doubted >= 0
                doubted = step
            elif finding in (FRAME_WRONG, PAST_WRONG):
                is_right = bool(each.frame_holds[doubted]) == (finding == PAST_WRONG)
                count["isolated_rightly" if is_right else "isolated_wrongly"] += 1
                doubted = -1
        count["undecided"] += doubted >= 0
    names = ("isolated_rightly", "isolated_wrongly", "undecided")
    return {f"{label}.{name}": float(of[name]) for label, of in counts.items() for name in names}


def _chart(summary: pd.DataFrame) -> Chart:
    """Draw the sets' median area, and how often they contain the robot, by robot."""
    panels = []
    for quantity, label in (
        ("area_m2", "median area (m²)"),
        ("inside", "share of frames with the robot inside"),
    ):
        series = curves(summary[summary["run"] == 0], ["estimator"], "case", quantity, "markers")
        panels.append(Panel(y=Axis(label=label, log=quantity == "area_m2"), series=series))
    return Chart(columns=2, panels=panels)


SET_FILTER = Study(
    "guaranteed sets over time: area, containment, benefit of the past, faults", study, BoundOptions
)
