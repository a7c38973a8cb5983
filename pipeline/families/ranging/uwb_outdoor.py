"""Study of positions from ranges outdoors: uwb_outdoor, compared with published tracks.

Published errors refer to a part of each path; this part begins and ends when the path enters given
regions. The truth is interpolated linearly, after samples with a wrong height are removed (see
`level_m`). Published tracks are evaluated at their own stamps, and our estimates are evaluated at the
stamps of the truth.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import PositiveFloat

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
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Booleans, Floats

PUBLISHED = ("LS", "ESKF")


class Place(Parameters):
    """A region of the plane in which a window begins or ends.

    Attributes:
        x_above_m: smallest x; None for no limit.
        x_below_m: largest x; None for no limit.
        y_above_m: smallest y; None for no limit.
        y_below_m: largest y; None for no limit.
    """

    x_above_m: float | None = None
    x_below_m: float | None = None
    y_above_m: float | None = None
    y_below_m: float | None = None

    def holds(self, position: Floats) -> Booleans:
        """Test which positions (n, 2) are in the region."""
        above = np.array([self.x_above_m, self.y_above_m], float)
        below = np.array([self.x_below_m, self.y_below_m], float)
        outside = (position <= above) | (position > below)  # comparisons with None (NaN) are false
        return np.asarray((np.isfinite(position) & ~outside).all(axis=1))


class Window(Parameters):
    """The part of a path that is evaluated.

    Attributes:
        begin: the window begins when the path first enters this region.
        end: the window ends when the path first enters this region after the beginning.
    """

    begin: Place = Place()
    end: Place = Place()


class UwbOutdoorOptions(RangingOptions):
    """The windows, and the selection of samples of the truth.

    Attributes:
        windows: the part of a path to evaluate, by the name of a folder that contains the recording;
            the whole path if there is no window.
        level_m: largest difference in m between the height of a sample of the truth and the path's
            median height.
    """

    windows: dict[str, Window] = {}
    level_m: PositiveFloat = 0.5


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: UwbOutdoorOptions = setting.options
    folders = [path.parent for path in recordings(setting, "trajectory.csv")]
    named = [Recording("-".join(each.resolve().parts[-3:]), each) for each in folders]
    found = list(replayed(experiment, setting, named))
    rows: list[dict[str, Any]] = []
    drawn = {}
    for each in found:
        window = next(
            (
                options.windows[part]
                for part in each.recording.path.resolve().parts
                if part in options.windows
            ),
            None,
        )
        truth, begin_ns, end_ns = scored_truth(each, window, options.level_m)
        published = {
            track: published_rmse(each, track, truth, begin_ns, end_ns)
            for track in PUBLISHED
            if f"/published/{track}" in each.source.streams
        }
        own = {}
        for label, outputs in each.outputs.items():
            inside = (truth.time_ns >= begin_ns) & (truth.time_ns <= end_ns)
            stamps, states = truth.time_ns[inside], outputs["state"]
            estimate = Reference(states.publish_time_ns, states["mean"][:, :2]).at(stamps)
            error = estimate - truth.state[inside, :2]
            nis = mean_nis(outputs["innovation"], begin_ns, end_ns)
            own[label] = {"position_rmse_m": rms_length(error), "nis": nis}
            if each is found[0]:
                drawn[label] = stamps, np.hypot(*error.T)
        name = each.recording.name
        paper = (
            printed(each.recording.path) if window else {}
        )  # published errors of other paths are for unknown parts
        rows += [{"estimator": label, "recording": name, **figures} for label, figures in own.items()]
        for track, (plane, space) in published.items():
            figures = {"position_rmse_m": plane, "space_rmse_m": space}
            rows.append({"estimator": f"published-{track}", "recording": name, **figures})
            if f"{track}_2d" in paper:
                figures = {"position_rmse_m": paper[f"{track}_2d"], "space_rmse_m": paper[track]}
                rows.append({"estimator": f"printed-{track}", "recording": name, **figures})
    outcome = outcome_of(found, rows)
    outcome.metrics = {key: value for key, value in outcome.metrics.items() if value == value}
    outcome.figures["errors"] = errors_chart(drawn, f"position error (m), {found[0].recording.name}")
    return outcome


def scored_truth(of: Replayed, window: Window | None, level_m: float) -> tuple[Reference, int, int]:
    """Return the truth x, y, z, and the first and last stamp to evaluate.

    Raises BadInput if the path does not cross the window.
    """
    stream = of.source.streams["/truth"]
    time_ns, state = stream.publish_time_ns, stream["state"][:, :3]
    begin, end = 0, len(time_ns) - 1
    if window is not None:
        starts = np.flatnonzero(window.begin.holds(state[:, :2]))
        begin = int(starts[0]) if len(starts) else len(time_ns)
        ends = begin + np.flatnonzero(window.end.holds(state[begin:, :2]))
        if not len(ends):
            raise BadInput(
                f"{of.recording.path}: its path does not cross the window; set options.windows to a "
                "window on the path, or to {} for the whole path"
            )
        end = int(ends[0])
    level = np.abs(state[:, 2] - np.median(state[:, 2])) < level_m
    return Reference(time_ns[level], state[level]), int(time_ns[begin]), int(time_ns[end])


def published_rmse(
    of: Replayed, track: str, truth: Reference, begin_ns: int, end_ns: int
) -> tuple[float, float]:
    """Compute the errors of a published track within the window, in the plane and in space."""
    stream = of.source.streams[f"/published/{track}"]
    inside = (stream.publish_time_ns >= begin_ns) & (stream.publish_time_ns <= end_ns)
    error = stream["state"][inside] - truth.at(stream.publish_time_ns[inside])
    return rms_length(error[:, :2]), rms_length(error)


def printed(folder: Path) -> dict[str, float]:
    """Read the errors that are published with a recording, by name; return {} if the file is missing."""
    path = folder / "RMSD_results.txt"
    if not path.exists():
        return {}
    lines = re.findall(r"(\w+) RMSE(_2d)?: *([\d.]+)", path.read_text(encoding="utf-8"))
    return {f"{track}{plane}": float(value) for track, plane, value in lines}


UWB_OUTDOOR = Study(
    "positions from ranges to anchors outdoors, compared with published tracks", study, UwbOutdoorOptions
)
