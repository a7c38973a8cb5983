"""Study of the S2KF paper's extended target, whose update has multiplicative noise.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.B, Figs. 9 and 10. In addition to the paper's filters, the study runs the S2KF with randomly
rotated sample sets: in eight dimensions, a set is unique only up to a rotation, and the results depend
on this rotation.
"""

from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.families.sampling.linearization import (
    REFERENCE,
    Ensemble,
    Floats,
    Options,
    ensembles,
    error_panel,
    rmse,
)
from fuselog.pipeline.output.charts import Axis, Chart, band
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.families.sampling.extended_target import area_m2

TURNED = "-rotation-"
KEY_STEPS = (25, 75, 150)
SMART = ("s2kf-25", "s2kf-50", "s2kf-100", "s2kf-200")


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
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
    for label, median in steps.groupby("estimator", sort=False)["median_area_m2"]:
        if TURNED not in str(label):
            outcome.metrics[f"{label}.least_median_area_m2"] = float(median.min())
            outcome.metrics[f"{label}.largest_median_area_m2"] = float(median.max())
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def rotated_estimators(experiment: Experiment, rotations: int) -> dict[str, dict[str, Any]]:
    """Return S2KF estimators with rotated sets of 25 and 50 samples, under their own labels."""
    return {
        f"{label}{TURNED}{turn}": values | {"kind": f"{values['kind']}:rotation={turn}"}
        for label, values in experiment.estimators.items()
        for turn in range(1, rotations + 1)
        if label in SMART[:2]
    }


def step_errors(ensemble: Ensemble) -> pd.DataFrame:
    """Tabulate errors by estimator and step.

    The columns are the RMSE of area and position relative to the filter with exact moments (as in the
    paper) and to the truth, and the median area. A half side of -l means the same rectangle as l, but
    with a negative area. Runs with a negative area are counted, and `size` is the absolute area. Failed
    runs are also counted.
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
    """Return the columns at the paper's steps, averaged over the seeds, with counts summed."""
    rows = steps[steps["step"].isin(KEY_STEPS)]
    counts = dict.fromkeys(("flipped_runs", "failed_runs"), "sum")
    means = dict.fromkeys((name for name in rows.columns if name.endswith(("_m", "_m2"))), "mean")
    return rows.groupby(["estimator", "step"], sort=False).agg(means | counts).reset_index()


def metrics(at_keys: pd.DataFrame) -> dict[str, MetricValue]:
    """Return every column at every key step; for rotated sets, lists with an entry per rotation."""
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
    """Return the area RMSE of a filter at one step, for every rotation of its sample set."""
    turned = at_keys["estimator"].str.startswith(label + TURNED) & (at_keys["step"] == step)
    return [float(value) for value in at_keys.loc[turned, "area_rmse_m2"]]


def error_chart(steps: pd.DataFrame) -> Chart:
    """Draw RMSE of position and area relative to exact moments, with the range of rotations, Fig. 9."""
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
    "sampling filters compared with exact moments: updates with points of an extended target",
    study,
    Options,
)
