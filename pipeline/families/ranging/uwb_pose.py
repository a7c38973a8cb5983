"""Study of poses from ranges between anchors and tags: lias, ultra-wideband with motion capture.

Estimates are evaluated at their stamps from `skip_s` on, and the truth is interpolated linearly. The
body of the motion capture differs slightly from that of the tags, so errors have a constant part that no
filter can estimate. Therefore, results are also computed after the mean error is subtracted.
"""

from typing import Any

import numpy as np
from pydantic import NonNegativeFloat

from fuselog.pipeline.families.ranging.study import (
    RangingOptions,
    Recording,
    Reference,
    Replayed,
    errors_chart,
    mean_nis,
    outcome_of,
    recordings,
    replayed,
)
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.studies.toolkit.repetitions import rms_length
from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats, Integers


class UwbPoseOptions(RangingOptions):
    """The time at which evaluation begins, and the mounting of the tags relative to the truth.

    Attributes:
        skip_s: time after the first estimate at which evaluation begins.
        mounting_yaw_deg: yaw of the tags' frame relative to the truth's body.
    """

    skip_s: NonNegativeFloat = 2.0
    mounting_yaw_deg: float = 0.0


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    pairs = []
    for path in recordings(setting, "UWB*.csv"):
        captured = path.with_name(path.name.replace("UWB", "motion_capture", 1))
        if not captured.exists():
            raise BadInput(
                f"{path}: the motion capture {captured.name} is missing in its folder; give the folder "
                "as published"
            )
        name = path.stem.removeprefix("UWB").strip("_") or path.parent.name
        pairs.append(Recording(name, path, (captured,)))
    found = list(replayed(experiment, setting, pairs))
    rows: list[dict[str, Any]] = []
    drawn = {}
    for each in found:
        for label in each.outputs:
            figures, time_ns, error = figures_of(each, label, setting.options)
            rows.append({"estimator": label, "recording": each.recording.name, **figures})
            if each is found[0]:
                drawn[label] = time_ns, np.hypot(error[:, 0], error[:, 1])
    outcome = outcome_of(found, rows)
    outcome.figures["errors"] = errors_chart(drawn, f"position error (m), {found[0].recording.name}")
    return outcome


def figures_of(
    of: Replayed, label: str, options: UwbPoseOptions
) -> tuple[dict[str, float], Integers, Floats]:
    """Compute one estimator's results, and its errors x, y, heading (n, 3) with their stamps (n,)."""
    captured = of.source.streams["/truth"]
    order = np.argsort(captured.publish_time_ns, kind="stable")
    yaw = np.unwrap(heading(captured["state"][order, 3:7])) + np.radians(options.mounting_yaw_deg)
    truth = Reference(
        captured.publish_time_ns[order], np.column_stack([captured["state"][order, :2], yaw])
    )
    states = of.outputs[label]["state"]
    stamps = states.publish_time_ns
    begin_ns = max(int(stamps[0]) + round(options.skip_s * 1e9), int(truth.time_ns[0]))
    rows = (stamps >= begin_ns) & (stamps <= truth.time_ns[-1])
    if not rows.any():
        raise BadInput(
            f"{of.recording.path}: no estimate of {label} is within the time span of the motion capture"
        )
    error = states["mean"][rows, :3] - truth.at(stamps[rows])
    error[:, 2] = wrap_angle(error[:, 2])
    size = round(np.sqrt(states["covariance"].shape[1]))
    information = np.linalg.inv(states["covariance"][rows].reshape(-1, size, size)[:, :3, :3])
    around = error - error.mean(axis=0)
    nees, nees_around = (
        float(np.mean(np.einsum("ki,kij,kj->k", each, information, each))) for each in (error, around)
    )
    figures = {
        "position_rmse_m": rms_length(error[:, :2]),
        "heading_rmse_deg": float(np.degrees(rms_length(error[:, 2:]))),
        "position_spread_m": rms_length(around[:, :2]),
        "heading_spread_deg": float(np.degrees(rms_length(around[:, 2:]))),
        "nis": mean_nis(of.outputs[label]["innovation"], begin_ns, int(truth.time_ns[-1])),
        "nees": nees,
        "nees_around_mean": nees_around,
    }
    return figures, stamps[rows], error


UWB_POSE = Study("poses in the plane from ranges between anchors and tags", study, UwbPoseOptions)
