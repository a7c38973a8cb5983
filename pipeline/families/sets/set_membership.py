"""Study of set-valued fixes: their areas, how often they contain the truth, and faults.

The paper, Briechle, Hanebeck (2004), shows its results as figures, without numbers. If the experiment is
simulated, the scene of section V is recorded in addition to the experiment's own runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, path
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.inputs import Record
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.replay.families.sets.judging.evaluation import JudgedSets, judge_sets
from fuselog.replay.families.sets.judging.regions import rings_of
from fuselog.replay.judging.errors.evaluation import split_topic

EXACT, BOX, L4, L8 = "exact", "box", "l4", "l8"
FIRST_PAIR, SECTION_V = "section-v-first-pair", "section-v"
FREE = ".error-free"


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    runner = Runner(experiment, setting)
    replayed = runner.replay(runner.obtain())
    found = judge_sets(replayed.outputs, replayed.sources, experiment.gap_limit_s)
    outcome = Outcome(tables={"frames": frame_table(found)})
    outcome.metrics |= set_metrics(found)
    if experiment.record is not None:
        outcome.metrics |= _ratios(found)
        outcome.metrics |= _without_errors(runner)
        shown = _section_v(runner, outcome)
        runner.keep(replayed.sources, replayed.outputs, drawn=None)
        runner.draw(shown.sources, shown.outputs)
    else:
        outcome.figures["bounds"] = _bounds_chart(outcome.metrics)
        runner.keep(replayed.sources, replayed.outputs)
    outcome.input_sha256 = hash_streams(replayed.sources)
    return outcome


def frame_table(found: Sequence[JudgedSets]) -> pd.DataFrame:
    """Tabulate areas and containment by estimator, case, run and frame."""
    parts = [
        pd.DataFrame(
            {
                "estimator": each.estimator,
                "case": each.case,
                "run": each.run,
                "time_ns": each.time_ns,
                "area_m2": each.area_m2,
                "truth_known": each.known,
                "truth_inside": each.inside,
                "truth_in_arena": each.in_arena,
                "bound_holds": each.bound_holds,
            }
        )
        for each in found
    ]
    return pd.concat(parts, ignore_index=True)


def set_metrics(found: Sequence[JudgedSets]) -> dict[str, MetricValue]:
    """Measure the share of sets that contain the truth, the median area, and the number of violations.

    A violation is a set that does not contain the truth although its error bounds are met and the robot
    is in the arena; robots outside the arena are counted separately. Metrics are computed for each case
    and for all cases together, over the frames that have a truth.
    """
    metrics: dict[str, MetricValue] = {}
    together: dict[str, list[JudgedSets]] = {}
    for each in found:
        together.setdefault(each.estimator, []).append(each)
    groups = {(name, ""): group for name, group in together.items()}
    groups |= {(each.estimator, f".{each.case}"): [each] for each in found}
    for (name, case), group in groups.items():
        known = np.concatenate([each.known for each in group])
        inside = np.concatenate([each.inside for each in group])[known]
        area = np.concatenate([each.area_m2 for each in group])[known]
        metrics[f"{name}.frames{case}"] = float(len(inside))
        metrics[f"{name}.containment_share{case}"] = float(inside.mean()) if len(inside) else None
        metrics[f"{name}.area_median_m2{case}"] = float(np.median(area)) if len(area) else None
        metrics[f"{name}.violations{case}"] = float(sum(each.violations for each in group))
        metrics[f"{name}.outside_arena{case}"] = float(sum(each.outside_arena for each in group))
        metrics[f"{name}.faults{case}"] = float(sum(each.faults for each in group))
    return metrics


def _without_errors(runner: Runner) -> dict[str, MetricValue]:
    """Compute the ratios of areas in the same scenes without errors, where exact sets are largest."""
    replayed = runner.replay(runner.obtain({"error_share": 0.0}))
    gap_limit_s = runner.experiment.gap_limit_s
    return _ratios(judge_sets(replayed.outputs, replayed.sources, gap_limit_s), FREE)


def _ratios(found: Sequence[JudgedSets], case: str = "") -> dict[str, MetricValue]:
    """Compute the median of area / exact area, and how often L4 and L8 sets are smaller than the box."""
    areas = {(each.estimator, each.case): each.area_m2 for each in found}
    metrics: dict[str, MetricValue] = {}
    for (name, of), area in areas.items():
        if name != EXACT and (EXACT, of) in areas:
            metrics[f"{name}.area_ratio_median{case}"] = float(np.median(area / areas[EXACT, of]))
        if name in (L4, L8) and (BOX, of) in areas:
            metrics[f"{name}.below_box_share{case}"] = float(np.mean(area < areas[BOX, of]))
    return metrics


def _section_v(runner: Runner, outcome: Outcome) -> Replayed:
    """Record and replay the first pair of the paper's scene, then all pairs; add metrics and figures."""
    experiment = runner.experiment
    assert experiment.record is not None
    bare = Record(scenario=experiment.record.scenario)
    runner = replace(runner, experiment=experiment.model_copy(update={"record": bare}))
    for case, pairs in ((FIRST_PAIR, 1), (SECTION_V, 3)):
        parameters = {"scene": "section-v", "paper_pairs": pairs}
        settings = {
            name: {**values, "least_landmarks": 2} for name, values in experiment.estimators.items()
        }
        replayed = runner.replay(runner.obtain(parameters, runs=1), settings)
        for each in judge_sets(replayed.outputs, replayed.sources, experiment.gap_limit_s):
            outcome.metrics[f"{each.estimator}.area_m2.{case}"] = float(each.area_m2[0])
        outcome.figures[case] = _set_chart(replayed, case)
    return replayed


def _set_chart(replayed: Replayed, title: str) -> Chart:
    """Draw the first sets of the first run, and the robot."""
    series = []
    for topic, sets in replayed.outputs.items():
        if topic.endswith("/set"):
            sizes = replayed.outputs[f"{topic.removesuffix('set')}size"]
            for ring in rings_of(sizes.stream, sets.stream)[0]:
                series.append(path(split_topic(topic)[0], np.append(ring, ring[:1], axis=0)))
    source = replayed.sources[0]
    robot = source.read(["/robot1/truth"])["/robot1/truth"]["state"][:1]
    series.append(path("truth", robot, "markers", reference=True))
    panel = Panel(x=Axis(label="x (m)"), y=Axis(label="y (m)"), series=series, plane=True)
    return Chart(title=title, panels=[panel])


def _bounds_chart(metrics: Mapping[str, MetricValue]) -> Chart:
    """Draw, by estimator, the area of the sets and how often they contain the truth."""
    names = [key.partition(".")[0] for key in metrics if key.endswith(".containment_share")]
    labels = {
        "containment_share": "share of sets that contain the truth",
        "area_median_m2": "median area (m²)",
    }
    panels = []
    for quantity, label in labels.items():
        values = [_value(metrics, f"{name}.{quantity}") for name in names]
        panels.append(Panel(y=Axis(label=label), series=[curve(label, names, values, "line+markers")]))
    return Chart(columns=2, panels=panels)


def _value(metrics: Mapping[str, MetricValue], key: str) -> float:
    """Return a metric if it is a number, otherwise NaN."""
    found = metrics.get(key)
    return float(found) if isinstance(found, int | float) else float("nan")


SET_MEMBERSHIP = Study("set-valued fixes: areas, containment of the truth, faults", study)
