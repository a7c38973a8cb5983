"""The extended target of the S2KF's paper: a measurement update with multiplicative noise.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.B, Figs. 9 and 10. Beside the paper's filters run the S2KF's with their sample sets turned at
random: a set in eight dimensions is unique only up to a rotation, and the results depend on it.
"""

from typing import Any

import numpy as np
import pandas as pd

from pipeline.output.charts import Axis, Chart, band
from pipeline.output.claims import Claim, judged, named
from pipeline.output.results import MetricValue, Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.studies.sampling.linearization import (
    REFERENCE,
    Ensemble,
    Floats,
    Options,
    ensembles,
    error_panel,
    falling,
    rmse,
)
from recorders.models.extended_target import area_m2

TURNED = "-rotation-"
KEY_STEPS = (25, 75, 150)
PAPER = ("ukf", "rukf-10", "s2kf-25", "s2kf-50")
SMART = ("s2kf-25", "s2kf-50", "s2kf-100", "s2kf-200")


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    turned = rotated_estimators(experiment, options.rotations)
    tables, sources = [], []
    for number, ensemble in enumerate(ensembles(experiment, setting, options, turned)):
        tables.append(step_errors(ensemble).assign(seed=experiment.seed + number))
        sources += ensemble.sources
    steps = pd.concat(tables)
    outcome = Outcome(tables={"steps": steps}, figures={"errors": error_chart(steps)})
    at_keys = by_key_step(steps)
    outcome.tables["summary"] = at_keys
    outcome.metrics |= metrics(at_keys)
    outcome.claims += claims(at_keys, steps)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def rotated_estimators(experiment: Experiment, rotations: int) -> dict[str, dict[str, Any]]:
    """The S2KF of 25 and 50 samples with their sets turned, under labels of their own."""
    return {
        f"{label}{TURNED}{turn}": values | {"kind": f"{values['kind']}:rotation={turn}"}
        for label, values in experiment.estimators.items()
        for turn in range(1, rotations + 1)
        if label in SMART[:2]
    }


def step_errors(ensemble: Ensemble) -> pd.DataFrame:
    """One row per estimator and step.

    RMSE of area and position against the exact moments' filter (the paper's) and against truth; the
    median area. A half side of -l is the rectangle of l, but flips the area's sign: such runs are
    counted, and `size` is the area without its sign. Failed runs are counted too.
    """
    exact = ensemble.tracks[REFERENCE].mean
    parts = []
    for label, track in ensemble.tracks.items():
        mean = track.mean
        parts.append(
            pd.DataFrame(
                {
                    "estimator": label,
                    "step": np.arange(1, mean.shape[1] + 1),
                    "area_rmse_m2": rmse(_area(mean) - _area(exact)),
                    "size_rmse_m2": rmse(abs(_area(mean)) - abs(_area(exact))),
                    "position_rmse_m": rmse(mean[..., 2:] - exact[..., 2:]),
                    "area_truth_rmse_m2": rmse(_area(mean) - _area(ensemble.truth)),
                    "position_truth_rmse_m": rmse(mean[..., 2:] - ensemble.truth[..., 2:]),
                    "median_area_m2": np.nanmedian(_area(mean), axis=0),
                    "flipped_runs": np.sum(np.any(mean[..., :2] < 0, axis=-1), axis=0),
                    "failed_runs": track.failed,
                }
            )
        )
    return pd.concat(parts)


def _area(target: Floats) -> Floats:
    area: Floats = area_m2(np.moveaxis(target, -1, 0))
    return area


def by_key_step(steps: pd.DataFrame) -> pd.DataFrame:
    """The columns at the paper's steps, averaged over the seeds; counts are summed."""
    rows = steps[steps["step"].isin(KEY_STEPS)]
    counts = dict.fromkeys(("flipped_runs", "failed_runs"), "sum")
    means = dict.fromkeys((name for name in rows.columns if name.endswith(("_m", "_m2"))), "mean")
    return rows.groupby(["estimator", "step"], sort=False).agg(means | counts).reset_index()


def metrics(at_keys: pd.DataFrame) -> dict[str, MetricValue]:
    """Every column at every key step; of turned sets a list, one entry per rotation."""
    found: dict[str, MetricValue] = {}
    columns = [name for name in at_keys.columns if name not in ("estimator", "step")]
    own = at_keys[~at_keys["estimator"].str.contains(TURNED)]
    for row in own.to_dict("records"):
        for name in columns:
            if row["estimator"] != REFERENCE or name.split("_")[1] != "rmse":
                found[f"{row['estimator']}.{name}.step-{row['step']}"] = float(row[name])
    for label in SMART[:2]:
        for step in KEY_STEPS:
            values = turned_areas(at_keys, label, step)
            if values:
                found[f"{label}.area_rmse_by_rotation_m2.step-{step}"] = values
    return found


def turned_areas(at_keys: pd.DataFrame, label: str, step: int) -> list[float]:
    """The area RMSE of every rotation of a filter's set at one step."""
    turned = at_keys["estimator"].str.startswith(label + TURNED) & (at_keys["step"] == step)
    return [float(value) for value in at_keys.loc[turned, "area_rmse_m2"]]


def claims(at_keys: pd.DataFrame, steps: pd.DataFrame) -> list[Claim]:
    """The paper's statements about Figs. 9 and 10.

    None for an experiment of one's own that lacks the paper's filters or steps.
    """
    first, middle, last = KEY_STEPS
    at = at_keys.set_index(["step", "estimator"])
    if not {(step, name) for step in KEY_STEPS for name in (*PAPER, *SMART)} <= set(at.index):
        return []
    area = {step: dict(at.loc[step]["area_rmse_m2"]) for step in KEY_STEPS}
    size = {step: dict(at.loc[step]["size_rmse_m2"]) for step in KEY_STEPS}
    position = {step: dict(at.loc[step]["position_rmse_m"]) for step in KEY_STEPS}
    flipped = dict(at.loc[last]["flipped_runs"])["rukf-10"]
    median = dict(at.loc[75]["median_area_m2"])
    unchanged = steps[steps["estimator"] == "ukf"]["median_area_m2"]
    path = {
        name: " / ".join(f"{area[step][name]:.3g}" for step in KEY_STEPS) for name in (*PAPER, *SMART)
    }
    found = [
        judged(
            "The UKF leaves its estimate of the area at 4 m2",
            "completely unchanged",
            f"median area between {unchanged.min():.3f} and {unchanged.max():.3f} m2 at all steps",
            bool(np.all(np.abs(unchanged - 4) < 0.01)),
        ),
        judged(
            "The UKF's area error converges to about 28 m2",
            "28 m2",
            f"{path['ukf']} m2 at steps 25 / 75 / 150",
            abs(area[last]["ukf"] - 28) < 2.8,
        ),
        judged(
            "The RUKF's area error is high and decreases only at a very low rate",
            "as the UKF's",
            f"without signs {size[first]['rukf-10']:.3g} / {size[middle]['rukf-10']:.3g} / "
            f"{size[last]['rukf-10']:.3g} m2 at steps 25 / 75 / 150; UKF {path['ukf']} m2",
            size[last]["rukf-10"] > 0.5 * size[first]["rukf-10"],
            f"with the signs of {flipped:.0f} runs, all seeds together, {path['rukf-10']} m2",
        ),
        judged(
            "The RUKF estimates the target much too small (Fig. 10, step 75)",
            "far smaller than the target",
            f"median area {named(median, 'rukf-10', REFERENCE)} m2",
            median["rukf-10"] < 0.8 * median[REFERENCE],
        ),
        judged(
            "The S2KF with 50 samples has the smallest area error of the paper's filters",
            "the only one that directly converges to a small error",
            "; ".join(f"{name} {path[name]}" for name in PAPER),
            all(area[step]["s2kf-50"] == min(area[step][name] for name in PAPER) for step in KEY_STEPS),
        ),
        judged(
            "The S2KF with 50 samples has the smallest position error of the paper's filters",
            "quickly to an error of nearly zero",
            f"at step {last}: {named(position[last], *PAPER)} m",
            position[last]["s2kf-50"] == min(position[last][name] for name in PAPER),
        ),
        judged(
            "All filters quickly decrease their position error, the UKF to a higher level",
            "UKF a little higher",
            f"step {first}: {named(position[first], *PAPER)}; {last}: {named(position[last], *PAPER)}",
            all(position[last][name] < position[first][name] for name in PAPER)
            and position[last]["ukf"] == max(position[last][name] for name in PAPER),
        ),
        judged(
            "The area converges to the analytic filter's with more samples, whatever the sample sets",
            "convergence evident from 25 to 50 samples",
            f"step {last}, one set each: {named(area[last], *SMART)} m2",
            falling([area[last][name] for name in SMART]),
            "a set is unique only up to a rotation, and in 8 dimensions the results depend on it",
        ),
    ]
    turned = turned_areas(at_keys, "s2kf-25", middle)
    if turned:
        found.append(
            judged(
                "The S2KF with 25 samples corrects its area relatively fast",
                "relatively fast",
                f"step {middle}, {len(turned)} rotations: {min(turned):.3g} to {max(turned):.3g}, "
                f"median {np.median(turned):.3g} m2; RUKF {area[middle]['rukf-10']:.3g} m2",
                float(np.median(turned)) < 2 * area[middle]["rukf-10"],
                "it depends on the rotation of the sample set",
            )
        )
    return found


def error_chart(steps: pd.DataFrame) -> Chart:
    """Fig. 9: RMSE of position and area against the exact moments, and the band of the rotations."""
    is_turned = steps["estimator"].str.contains(TURNED)
    own = steps[~is_turned & (steps["estimator"] != REFERENCE)]
    panels = []
    for quantity, of in (("position_rmse_m", "position (m)"), ("area_rmse_m2", "area (m²)")):
        panel = error_panel(own, quantity, f"RMSE of the {of}")
        for name in SMART[:2]:
            rows = steps[steps["estimator"].str.startswith(name + TURNED)]
            if len(rows):
                by_turn = rows.pivot_table(quantity, "estimator", "step")
                label = f"{name}, {len(by_turn)} rotations"
                panel.bands.append(band(label, by_turn.columns, by_turn.min(), by_turn.max()))
        panels.append(panel.model_copy(update={"y": Axis(label=panel.y.label, log=True)}))
    return Chart(title="Extended target against the analytic moments", columns=2, panels=panels)


EXTENDED_TARGET = Study(
    "sampling filters against exact moments: updates by points of an extended target", study, Options
)
