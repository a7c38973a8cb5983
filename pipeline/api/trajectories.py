"""Evaluation of trajectories from two files or from logs, with metrics, tables and figures."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, path, thinned
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.log import schemas
from fuselog.recorders.log.planes import stated_in
from fuselog.recorders.trajectories import Trajectory, read_trajectory
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.planes import into_plane_of
from fuselog.replay.engine.streams.sources import LogSource, Source
from fuselog.replay.judging.errors.alignment import Align, AlignedEstimates
from fuselog.replay.judging.errors.evaluation import split_topic
from fuselog.replay.judging.errors.planes import first_fixes, unlike
from fuselog.replay.judging.errors.trajectories import (
    Association,
    Compared,
    Comparison,
    DeltaUnit,
    compare,
    trajectory_metrics,
)
from fuselog.replay.judging.errors.trajectory_streams import trajectory_of
from fuselog.replay.judging.metrics.measuring import metric_key

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = "xyz"


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """An estimated trajectory compared with the true one.

    Attributes:
        estimate, truth: the trajectories, as given.
        comparison: the options of the comparison.
        compared: the comparison by pose, with the aligned estimate.
    """

    estimate: Trajectory
    truth: Trajectory
    comparison: Comparison
    compared: Compared

    @cached_property
    def metrics(self) -> dict[str, float]:
        """Compute APE and RPE, such as `ape_translation_rmse_m`, and the numbers of poses and pairs."""
        return trajectory_metrics([self.compared])

    @property
    def alignment(self) -> dict[str, Any]:
        """Return the transform that aligns the estimate: rotation (w, x, y, z), translation, scale."""
        rotation, translation_m, scale = self.compared.alignment
        quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
        return {
            "rotation": quaternion.tolist(),
            "translation_m": translation_m.tolist(),
            "scale": scale,
        }

    @property
    def notes(self) -> list[str]:
        """Return notes on both trajectories, on doubtful results, and on a failed time-offset search."""
        sought = self.comparison.time_offset_s == "estimate"
        in_vain = "no time offset makes the error smaller; none was added"
        notes = [in_vain] if sought and not self.compared.time_offset_s else []
        return [*self.estimate.notes, *self.truth.notes, *notes, *self.compared.doubts]

    @property
    def poses(self) -> pd.DataFrame:
        """Return a table with a row per pose with truth: stamp, aligned and true position, APE."""
        done = self.compared
        columns: dict[str, Any] = {}
        if done.estimate.time_ns is not None:
            columns["time_ns"] = done.estimate.time_ns
        for name, each in (("", done.estimate), ("true_", done.truth)):
            columns |= {f"{name}{axis}_m": each.position_m[:, i] for i, axis in enumerate(AXES)}
        columns["ape_translation_m"] = done.absolute_m
        if done.absolute_deg is not None:
            columns["ape_rotation_deg"] = done.absolute_deg
        return pd.DataFrame(columns)

    @property
    def pairs(self) -> pd.DataFrame:
        """Return a table with a row per pair of poses: number of the later pose, and RPE."""
        done = self.compared
        columns = {"last_pose": done.last, "rpe_translation_m": done.relative_m}
        if done.relative_deg is not None:
            columns["rpe_rotation_deg"] = done.relative_deg
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        name = f"{self.estimate.name} against {self.truth.name}, align {self.comparison.align}"
        values = [f"  {key:28} {value:.6g}" for key, value in self.metrics.items()]
        return "\n".join([name, *self.notes, *values])

    def figure(self) -> "Figure":
        """Draw the path in matplotlib, coloured by error."""
        return error_along_path(self.compared)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write metrics, tables and figures to the result folder `folder`, for `fuselog report`.

        Raises BadInput if the folder exists and is not a result of fuselog.
        """
        place = Path(folder)
        names = [self.estimate.name, self.truth.name]
        check_folder(place, {"input": [Path(name) for name in names]})
        outcome = Outcome(
            metrics={**self.metrics},
            tables={"summary": summary_table(self.metrics), "poses": self.poses, "pairs": self.pairs},
            figures=trajectory_figures({"estimate": self.compared}),
            input_sha256=self._hash(),
            kind="evaluate",
        )
        settings = {
            "title": f"{Path(names[0]).name} against {Path(names[1]).name}",
            "estimate": names[0],
            "truth": names[1],
            **asdict(self.comparison),
            "alignment": self.alignment,
            "added_time_offset_s": self.compared.time_offset_s,
        }
        with result_folder(place) as part:
            return ResultFolder(place, write_outcome(part, "evaluate", settings, outcome))

    def _hash(self) -> str:
        """Hash the poses of both trajectories with SHA-256."""
        digest = hashlib.sha256()
        for each in (self.estimate, self.truth):
            for array in (each.time_ns, each.position_m, each.rotation):
                if array is not None:
                    digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()


@without_warnings_of_numbers()
def evaluate(
    estimate: str | Path | Trajectory,
    /,
    *,
    truth: str | Path | Trajectory,
    align: Align = "none",
    delta: float = 1.0,
    delta_unit: DeltaUnit = "frames",
    association: Association = "nearest",
    max_difference_s: float = 0.01,
    gap_limit_s: float = 0.2,
    time_offset_s: float | Literal["estimate"] = 0.0,
    format: str | None = None,  # noqa: A002
    truth_format: str | None = None,
) -> Evaluation:
    """Evaluate an estimated trajectory against the true one, with the metrics of evo.

    Args:
        estimate: a TUM, KITTI or EuRoC file, or a trajectory in memory.
        truth: the true trajectory, in the same forms.
        align: the transform that aligns the estimate with the truth: "none", "yaw" (rotation about the
            vertical axis, and translation), "se2" (the same, with the height unchanged), "se3", "sim3".
        delta: the distance over which relative errors are computed.
        delta_unit: unit of `delta`: "m" along the estimate's path, "frames" or "s".
        association: "nearest" pairs poses that are close in time; "interpolated" interpolates the truth.
        max_difference_s: the largest time difference of matched poses, for "nearest".
        gap_limit_s: the longest gap over which the truth is interpolated.
        time_offset_s: offset in seconds to add to the estimate's stamps; "estimate" finds the offset
            with the smallest error.
        format: format of the estimate's file: "tum", "kitti", "euroc"; by default detected.
        truth_format: format of the truth's file.

    Returns:
        Both trajectories and their errors, absolute (APE) and relative (RPE), in m and degrees.

    Raises BadInput if a file contains no trajectory, or the two cannot be compared.

    >>> way = np.array([[0.0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 3, 0]])
    >>> turned = Trajectory("turned", way @ [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]] + 5.0)
    >>> found = evaluate(turned, truth=Trajectory("way", way), align="se3")
    >>> round(found.metrics["ape_translation_rmse_m"], 9)
    0.0
    """
    comparison = Comparison(
        align, delta, delta_unit, association, max_difference_s, gap_limit_s, time_offset_s
    )
    given = estimate if isinstance(estimate, Trajectory) else read_trajectory(estimate, format)
    true = truth if isinstance(truth, Trajectory) else read_trajectory(truth, truth_format)
    return Evaluation(given, true, comparison, compare(given, true, comparison))


@dataclass(frozen=True)
class ComparedLogs:
    """Estimates of logs as trajectories, compared with the truth.

    Attributes:
        estimates: the estimates of every run, aligned with the truth.
        compared: the comparisons by estimator and case, for the runs that have both estimates and truth.
    """

    estimates: Sequence[Source]
    compared: Mapping[tuple[str, str], Sequence[Compared]]

    @property
    def metrics(self) -> dict[str, float]:
        """Compute APE and RPE over all runs, as `estimator.ape_translation_rmse_m[.case]`."""
        return {
            metric_key(estimator, quantity, case): value
            for (estimator, case), runs in self.compared.items()
            for quantity, value in trajectory_metrics(runs).items()
        }

    @property
    def notes(self) -> list[str]:
        """Return sentences on the limitations of the metrics."""
        return [each for runs in self.compared.values() for run in runs for each in run.doubts]

    @property
    def figures(self) -> dict[str, "Chart | Figure"]:
        """Draw the figures of the first run, by case."""
        cases: dict[str, dict[str, Compared]] = {}
        for (estimator, case), runs in self.compared.items():
            cases.setdefault(case, {})[estimator] = runs[0]
        figures: dict[str, Chart | Figure] = {}
        for case, found in cases.items():
            figures |= trajectory_figures(found, f"-{case}" if case else "")
        return figures


def compare_logs(
    estimates: Sequence[LogSource], sources: Sequence[LogSource], comparison: Comparison
) -> ComparedLogs:
    """Compare the estimated positions in logs with the truth, where each run is aligned separately.

    Memory holds the poses of all runs.

    Raises BadInput if `compare` does, if an alignment would tilt a planar state out of its plane, or if
    unaligned estimates and truth are in local tangent planes that cannot be compared.
    """
    compared: dict[tuple[str, str], list[Compared]] = {}
    aligned: list[Source] = []
    for of_run, source in zip(estimates, sources, strict=True):
        alignments = {}
        origin_topics = [each for each in of_run.topics if each.endswith("/origin")]
        origins = first_fixes({each: gather([of_run[each]]) for each in origin_topics})
        for topic, stated in of_run.topics.items():
            truth_topic = stated.metadata.get("truth", "")
            if stated.schema_name != schemas.GAUSSIAN_ESTIMATE.full_name:
                continue
            if not topic.startswith("/estimates/") or truth_topic not in source.topics:
                continue
            true_states = source[truth_topic]
            if plane := stated_in(topic, stated.metadata):
                true_states = into_plane_of(true_states, plane)
            found, true = trajectory_of(of_run[topic]), trajectory_of(true_states)
            if found is None or true is None or not len(found) or not len(true):
                continue
            found = replace(found, name=f"{of_run.name}: topic {topic}")
            if comparison.align == "none" and (why := unlike(of_run.empty(topic), [source], origins)):
                raise BadInput(f"{found.name}: cannot be compared without alignment: {why}")
            done = compare(found, true, comparison)
            compared.setdefault(split_topic(topic), []).append(done)
            alignments[topic] = done.alignment
        aligned.append(AlignedEstimates(of_run.log, alignments=alignments))
    return ComparedLogs(aligned, compared)


def trajectory_figures(
    compared: Mapping[str, Compared], suffix: str = ""
) -> dict[str, "Chart | Figure"]:
    """Draw the paths and errors of all labels, and each label's path coloured by error, as in evo."""
    figures: dict[str, Chart | Figure] = {
        f"trajectory{suffix}": _path_chart(compared),
        f"pose-errors{suffix}": _error_chart(compared),
    }
    for label, done in compared.items():
        figures[f"error-along-path-{label}{suffix}"] = error_along_path(done)
    return figures


def _plane(truth: Trajectory) -> list[int]:
    """Find the ground plane in any axis convention: the two axes along which the truth extends most."""
    return sorted(np.argsort(-np.ptp(truth.position_m, axis=0), kind="stable")[:2].tolist())


def _path_chart(compared: Mapping[str, Compared]) -> Chart:
    first = next(iter(compared.values()))
    plane = _plane(first.truth)
    few = thinned(len(first.truth))
    series = [path("truth", first.truth.position_m[few][:, plane], "dashed", reference=True)]
    for label, done in compared.items():
        series.append(path(label, done.estimate.position_m[thinned(len(done.estimate))][:, plane]))
    x, y = (Axis(label=f"{AXES[axis]} (m)") for axis in plane)
    return Chart(title="paths", panels=[Panel(x=x, y=y, series=series, plane=True)])


def _error_chart(compared: Mapping[str, Compared]) -> Chart:
    """Draw APE at every pose and RPE at the later pose of every pair, over time or pose number."""
    timed = all(done.estimate.time_ns is not None for done in compared.values())
    x = Axis(label="time (s)" if timed else "pose")
    panels = []
    for title, field in (
        ("APE, translation (m)", "absolute_m"),
        ("APE, rotation (deg)", "absolute_deg"),
        ("RPE, translation (m)", "relative_m"),
        ("RPE, rotation (deg)", "relative_deg"),
    ):
        series = []
        for label, done in compared.items():
            error = getattr(done, field)
            if error is None:
                continue
            at = _places(done) if field.startswith("absolute") else _places(done)[done.last]
            few = thinned(len(error))
            series.append(curve(label, at[few], error[few]))
        if series:
            panels.append(Panel(x=x, y=Axis(label=title), series=series))
    return Chart(title="pose errors", panels=panels, columns=2)


def _places(done: Compared) -> np.ndarray:
    stamps = done.estimate.time_ns
    return np.arange(len(done.estimate)) if stamps is None else (stamps - stamps[0]) * 1e-9


def error_along_path(done: Compared) -> "Figure":
    """Draw the aligned path, coloured by APE, and the true path."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    plane = _plane(done.truth)
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    few = thinned(len(done.truth))
    x, y = done.truth.position_m[few][:, plane].T
    axes.plot(x, y, "--", color="#808080", linewidth=1.0, label="truth")
    points = done.estimate.position_m[few][:, plane]
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)), cmap="turbo", linewidths=2.0
    )
    lines.set_array(done.absolute_m[few][1:])
    axes.add_collection(lines)
    axes.autoscale_view()
    axes.set(xlabel=f"{AXES[plane[0]]} (m)", ylabel=f"{AXES[plane[1]]} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.colorbar(lines, label="APE, translation (m)")
    return figure
