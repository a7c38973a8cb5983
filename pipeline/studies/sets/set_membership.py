"""The study of set-valued fixes: areas, containment of the truth, faults.

Claims: Briechle, Hanebeck (2004), whose figures have no numbers; section V is recorded besides the
experiment's own runs wherever these are simulated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from pipeline.output.charts import Axis, Chart, Panel, curve, path
from pipeline.output.claims import Claim, judged
from pipeline.output.results import MetricValue, Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Record, Setting, Study
from pipeline.runs.recorded import Replayed
from pipeline.runs.runner import Runner
from replay.judging.errors.evaluation import split_topic
from replay.judging.sets.evaluation import JudgedSets, frames_of, judge_sets

EXACT, BOX, L4, L8 = "exact", "box", "l4", "l8"
FIRST_PAIR, SECTION_V = "section-v-first-pair", "section-v"
FREE = ".error-free"


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
        outcome.claims = _claims(outcome.metrics)
    else:
        outcome.figures["bounds"] = _bounds_chart(outcome.metrics)
        outcome.claims = [_guarantee(outcome.metrics)]
        runner.keep(replayed.sources, replayed.outputs)
    outcome.input_sha256 = hash_streams(replayed.sources)
    return outcome


def frame_table(found: Sequence[JudgedSets]) -> pd.DataFrame:
    """One row per estimator, case, run and frame."""
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
    """Share of the sets that hold the truth, median area, and how many miss it although they must not.

    A set must hold the truth where its bounds hold and the robot is in its arena; how often it is not is
    counted apart. Per case and all cases together, of the frames that have a truth.
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
    """The ratios of the same scenes where nothing errs: their exact sets are the largest."""
    replayed = runner.replay(runner.obtain({"error_share": 0.0}))
    gap_limit_s = runner.experiment.gap_limit_s
    return _ratios(judge_sets(replayed.outputs, replayed.sources, gap_limit_s), FREE)


def _ratios(found: Sequence[JudgedSets], case: str = "") -> dict[str, MetricValue]:
    """The median of area / exact area over the frames, and in what share of them the box is larger."""
    areas = {(each.estimator, each.case): each.area_m2 for each in found}
    metrics: dict[str, MetricValue] = {}
    for (name, of), area in areas.items():
        if name != EXACT and (EXACT, of) in areas:
            metrics[f"{name}.area_ratio_median{case}"] = float(np.median(area / areas[EXACT, of]))
        if name in (L4, L8) and (BOX, of) in areas:
            metrics[f"{name}.below_box_share{case}"] = float(np.mean(area < areas[BOX, of]))
    return metrics


def _section_v(runner: Runner, outcome: Outcome) -> Replayed:
    """Record and replay the paper's scene's first pair, then all of it; metrics and pictures."""
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
    """The first sets of the first run, and where the robot is."""
    series = []
    for topic, sets in replayed.outputs.items():
        if topic.endswith("/set"):
            sizes = replayed.outputs[f"{topic.removesuffix('set')}size"]
            for ring in frames_of(sizes.stream, sets.stream)[0]:
                series.append(path(split_topic(topic)[0], np.append(ring, ring[:1], axis=0)))
    source = replayed.sources[0]
    robot = source.read(["/robot1/truth"])["/robot1/truth"]["state"][:1]
    series.append(path("truth", robot, "markers", reference=True))
    panel = Panel(x=Axis(label="x (m)"), y=Axis(label="y (m)"), series=series, plane=True)
    return Chart(title=title, panels=[panel])


def _bounds_chart(metrics: Mapping[str, MetricValue]) -> Chart:
    """Containment and area, estimator by estimator."""
    names = [key.partition(".")[0] for key in metrics if key.endswith(".containment_share")]
    labels = {
        "containment_share": "share of sets that hold the truth",
        "area_median_m2": "median area (m²)",
    }
    panels = []
    for quantity, label in labels.items():
        values = [_value(metrics, f"{name}.{quantity}") for name in names]
        panels.append(Panel(y=Axis(label=label), series=[curve(label, names, values, "line+markers")]))
    return Chart(columns=2, panels=panels)


def _claims(metrics: Mapping[str, MetricValue]) -> list[Claim]:
    """The paper's statements against the measured areas; those whose estimators were run."""

    def value(key: str) -> float:
        return _value(metrics, key)

    def area(name: str, case: str) -> float:
        return value(f"{name}.area_m2.{case}")

    def ratio(name: str, case: str = "") -> float:
        return value(f"{name}.area_ratio_median{case}")

    def share(name: str, case: str = "") -> float:
        return value(f"{name}.below_box_share{case}")

    first, final, frames = FIRST_PAIR, SECTION_V, value(f"{L8}.frames")
    rows = [
        (
            "L = 8 approximates the first pair's set tighter than L = 4 (Figs. 5, 6)",
            "figures without numbers",
            f"L8 {area(L8, first):.4f}, L4 {area(L4, first):.4f}, exact {area(EXACT, first):.4f} m²",
            area(EXACT, first) < area(L8, first) < area(L4, first),
            "",
        ),
        (
            "after the first pair L = 4 is much tighter than the smallest box",
            "text to Fig. 6",
            f"L4 {area(L4, first):.4f}, box {area(BOX, first):.4f} m²",
            area(L4, first) < 0.5 * area(BOX, first),
            "",
        ),
        (
            "the final set with L = 8 is much tighter than the tightest box (Fig. 8)",
            "figure without numbers",
            f"L8 {area(L8, final):.5f}, box {area(BOX, final):.5f}, exact {area(EXACT, final):.5f} m²",
            area(EXACT, final) < area(L8, final) < 0.8 * area(BOX, final),
            "",
        ),
        (
            "the volume of the approximation is smaller than that of the box",
            "section III-B, tighter bound",
            f"final set: L4 {area(L4, final):.5f}, box {area(BOX, final):.5f} m²",
            area(L4, final) < area(BOX, final) and area(L8, final) < area(BOX, final),
            "false for L = 4 after three pairs, true for L = 8",
        ),
        *(
            (
                f"the approximation with {title} outperforms boxes",
                "section VI",
                f"smaller in {100 * share(name):.0f} %, without errors {100 * share(name, FREE):.0f} %, "
                f"of {frames:.0f} random scenes; median of area / exact area {ratio(name):.2f}, box "
                f"{ratio(BOX):.2f}, without errors {ratio(name, FREE):.2f}, box {ratio(BOX, FREE):.2f}",
                min(share(name), share(name, FREE)) > 0.5 + 1 / np.sqrt(frames),
                "in more than half of the scenes, by two standard errors",
            )
            for title, name in (("L = 8", L8), ("L = 4", L4))
        ),
    ]
    claims = [
        judged(claim, paper, ours, holds, why)
        for claim, paper, ours, holds, why in rows
        if "nan" not in ours
    ]
    return [
        _guarantee(metrics),
        *claims,
        Claim(
            "the areas of Figs. 5 to 8",
            "not printed",
            "ours are in the metrics",
            "not reproducible",
            "the criterion of lambda, the number of sweeps and the prior are unstated",
        ),
    ]


def _guarantee(metrics: Mapping[str, MetricValue]) -> Claim:
    """That no set misses the truth whose bounds hold; a bound that is broken guarantees nothing."""
    names = [key.partition(".")[0] for key in metrics if key.endswith(".containment_share")]
    missed = {name: _value(metrics, f"{name}.violations") for name in names}
    outside = max((_value(metrics, f"{name}.outside_arena") for name in names), default=0.0)
    told = ", ".join(
        f"{name} {missed[name]:.0f} ({_value(metrics, f'{name}.containment_share'):.4f})"
        for name in names
    )
    return judged(
        "the sets are guaranteed to hold the robot's position where the bound holds",
        "section III-B, conservativeness",
        f"sets that miss it although it does (share of all sets that hold it): {told}",
        not any(missed.values()),
        f"{outside:.0f} frames are left out: the robot was outside the arena" if outside else "",
    )


def _value(metrics: Mapping[str, MetricValue], key: str) -> float:
    """A metric that is one number; NaN where there is none."""
    found = metrics.get(key)
    return float(found) if isinstance(found, int | float) else float("nan")


SET_MEMBERSHIP = Study("set-valued fixes: areas, containment of the truth, faults", study)
