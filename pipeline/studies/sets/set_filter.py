"""The study of guaranteed sets over time: area, containment, how much the past helps, what was isolated.

The claims are ours, papers have no numbers of this; each was set before its numbers were seen. What is
compared are the frames for which all estimators have a set or an ellipse; intervals are over the robots.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from pipeline.output.charts import Axis, Chart, Panel, curve
from pipeline.output.claims import Claim, judged
from pipeline.output.results import MetricValue, Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.runner import Runner
from pipeline.studies.sets.error_bounds import BoundOptions, state_bounds
from pipeline.studies.toolkit.repetitions import Interval, mean_interval
from replay.distributions import chi2
from replay.judging.errors.evaluation import Errors
from replay.judging.sets.evaluation import JudgedSets, judge_sets
from replay.judging.sets.filter_evaluation import JudgedFilter, judge_filter
from replay.regions.frames import (
    CONTRADICTS_ITSELF,
    CONTRADICTS_PAST,
    FRAME_WRONG,
    PAST_WRONG,
    UNDECIDED,
)

ELLIPSE = 0.99
FRAMES, FILTER, L8, EKF, BEARINGS = "frames", "filter", "filter-l8", "ekf", "ekf-bearings"
KEYS = ["case", "run", "time_ns"]
OWN = "(own claim)"


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
    outcome.claims = _claims(outcome.metrics, summary, filters)
    outcome.figures["sets"] = _chart(summary)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _set_rows(found: JudgedSets) -> pd.DataFrame:
    """The sets of one estimator and robot, where the truth is known."""
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
    """The ellipses of one estimator and robot at the stamps of its sets: the estimate last said."""
    squared_radius = float(chi2.ppf(ELLIPSE, 2))
    place = errors.position
    error, covariance = errors.error[:, place], errors.covariance[:, place][:, :, place]
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    said = pd.DataFrame(
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
    rows = pd.merge_asof(wanted, said.sort_values("time_ns"), on="time_ns", by="run").dropna()
    return rows.assign(estimator=errors.estimator, case=errors.case, inside=rows["inside"].astype(bool))


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """The rows of frames for which every estimator has one."""
    count = table.groupby(KEYS)["estimator"].transform("nunique")
    return table[count == table["estimator"].nunique()].reset_index(drop=True)


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Median area of what is not empty, and share that holds the truth, by estimator, robot and run."""
    there = table.assign(area_m2=table["area_m2"].where(table["area_m2"] > 0.0))
    groups = there.groupby(["estimator", "case", "run"], sort=False)
    return groups.agg(area_m2=("area_m2", "median"), inside=("inside", "mean")).reset_index()


def filter_metrics(found: Sequence[JudgedFilter]) -> dict[str, MetricValue]:
    """What the sets rest on, how often that held, and what was found wrong; by filter and robot."""
    metrics: dict[str, MetricValue] = {}
    for each in found:
        known = each.sets.known
        values = {
            "frames": known.sum(),
            "violations": each.violations,
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


def _claims(
    metrics: Mapping[str, MetricValue], summary: pd.DataFrame, filters: Sequence[JudgedFilter]
) -> list[Claim]:
    """What is demanded of the sets; those claims whose estimators were run."""
    claims = [_guarantee(filters)]
    wide = summary.pivot_table(index=["case", "run"], columns="estimator")
    area, inside = wide["area_m2"], wide["inside"]

    def ratio(one: str, other: str) -> Interval:
        return _exponential(mean_interval(np.log(area[one] / area[other]).to_list()))

    if {FRAMES, FILTER} <= set(area):
        past = ratio(FILTER, FRAMES)
        claims.append(
            judged(
                "the past halves the sets of single frames",
                OWN,
                f"median area over that of frames alone {_told(past)}",
                past.high <= 0.5,
                "confirmed if the interval's upper end is .5 or less",
            )
        )
    if {L8, FILTER} <= set(area):
        loss = ratio(L8, FILTER)
        claims.append(
            judged(
                "L = 8 in place of polygons costs less than half of the area again",
                OWN,
                f"median area over that of polygons {_told(loss)}",
                loss.high <= 1.5,
                "confirmed if the interval's upper end is 1.5 or less",
            )
        )
    for name in (EKF, BEARINGS):
        if {name, FILTER} <= set(area):
            more = mean_interval((inside[FILTER] - inside[name]).to_list())
            size = ratio(FILTER, name)
            claims.append(
                judged(
                    f"the sets hold the robot more often than the 99 % ellipses of {name}",
                    OWN,
                    f"in {inside[FILTER].mean():.1%} and {inside[name].mean():.1%} of frames, "
                    f"difference {100 * more.mean:.1f} %, 95 % {100 * more.low:.1f} to "
                    f"{100 * more.high:.1f} %; area over that of the ellipses {_told(size)}",
                    more.low > 0.0,
                    "confirmed if the interval is above 0",
                )
            )
    held = mean_interval(
        [
            float(value)
            for key, value in metrics.items()
            if key.startswith(f"{FILTER}.guaranteed_share.") and isinstance(value, float)
        ]
    )
    claims.append(
        judged(
            "bounds taken from other robots are worth something: nine sets of ten are guaranteed",
            OWN,
            f"share of the sets {_told(held)}",
            held.low >= 0.9,
            "confirmed if the interval's lower end is .9 or more",
        )
    )
    claims.append(_isolation(filters))
    return claims


def _guarantee(filters: Sequence[JudgedFilter]) -> Claim:
    """That no set misses the truth that must hold it."""
    counts: dict[str, list[int]] = {}
    for each in filters:
        count = counts.setdefault(each.sets.estimator, [0, 0])
        count[0] += each.violations
        count[1] += int(each.guaranteed.sum())
    told = ", ".join(f"{name} {missed} of {held}" for name, (missed, held) in counts.items())
    return judged(
        "sets hold the robot where odometry, bearings and arena have kept their bounds since one did",
        OWN,
        f"sets that miss it although they must not: {told}",
        not any(missed for missed, _ in counts.values()),
    )


def _isolation(filters: Sequence[JudgedFilter]) -> Claim:
    """That frames that are isolated as wrong are so, by the truth."""
    right = isolated = open_ = 0
    for each in filters:
        if each.sets.estimator != FILTER:
            continue
        doubted = -1
        for step, finding in enumerate(each.finding.tolist()):
            if finding in (CONTRADICTS_PAST, UNDECIDED):
                open_ += doubted >= 0
                doubted = step
            elif finding in (FRAME_WRONG, PAST_WRONG):
                isolated += 1
                right += bool(each.frame_holds[doubted]) == (finding == PAST_WRONG)
                doubted = -1
        open_ += doubted >= 0
    return judged(
        "of a frame and a past that contradict each other the wrong one is isolated by later frames",
        OWN,
        f"{right} rightly, {isolated - right} wrongly, {open_} not decided",
        right >= 0.9 * (isolated + open_),
        "confirmed if nine of ten contradictions are rightly decided",
    )


def _exponential(interval: Interval) -> Interval:
    return Interval(*np.exp(interval).tolist())


def _told(interval: Interval) -> str:
    return f"{interval.mean:.3g}, 95 % {interval.low:.3g} to {interval.high:.3g}"


def _chart(summary: pd.DataFrame) -> Chart:
    """Area and containment, robot by robot."""
    panels = []
    for quantity, label in (("area_m2", "median area (m²)"), ("inside", "share that holds the robot")):
        series = [
            curve(str(estimator), rows["case"], rows[quantity], "markers")
            for estimator, rows in summary[summary["run"] == 0].groupby("estimator", sort=False)
        ]
        panels.append(Panel(y=Axis(label=label, log=quantity == "area_m2"), series=series))
    return Chart(columns=2, panels=panels)


SET_FILTER = Study(
    "guaranteed sets over time: area, containment, what the past helps, faults", study, BoundOptions
)
