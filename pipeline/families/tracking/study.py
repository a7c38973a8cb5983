"""Common parts of studies of trackers: evaluation of tracks by run, and comparison of trackers.

Tracks are evaluated as in `fuselog.replay.families.tracking.judging.errors`, at the same instants for
all trackers.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.output.results import Outcome
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.families.tracking.judging.distances import trajectory_gospa
from fuselog.replay.families.tracking.judging.errors import (
    CUTOFF_M,
    PERIOD_S,
    Judged,
    TracksAt,
    as_trajectories,
    figures_of_whole_tracks,
    near_tracks,
    track_errors,
    track_figures,
    tracks_at,
)
from fuselog.replay.judging.errors.evaluation import Innovations
from fuselog.replay.judging.intervals import Interval, mean_interval

# The quantities in which trackers are compared.
COMPARED = (
    *("gospa_m", "localisation_m2", "switches", "target1_rmse_m", "target1_coverage"),
    *("target2_rmse_m", "target2_coverage", "target5_rmse_m"),
)
# Trajectory GOSPA's penalty for a target that continues with another track: half a missed target.
SWITCH_PENALTY_M = 10.0


def sets_of(outputs: Mapping[str, Ragged], label: str, run: int) -> tuple[Stream, Stream]:
    """Return an estimator's number of tracks in every scan of a run, and the tracks themselves.

    Raises BadInput if the estimator is not a tracker.
    """
    leaves = [f"/estimates/{label}/{leaf}" for leaf in ("set", "track")]
    if not all(leaf in outputs for leaf in leaves):
        raise BadInput(f"estimator {label} gives no tracks, but this study compares trackers; remove it")
    sizes, tracks = (outputs[leaf].of_run(run) for leaf in leaves)
    return sizes, tracks


def figures_of(
    tracked: Sequence[TracksAt], truths: Floats, unreferenced_m: float = np.inf
) -> dict[str, float]:
    """Compute performance measures of the tracks of a run.

    If only some targets have a truth, measures of whole tracks ignore each track that never comes within
    the cutoff of a target with a truth. A track's length is the time from its first to its last instant.
    Trajectory GOSPA is divided by the square root of the number of instants, so that it can be compared
    with GOSPA.

    Args:
        tracked: the tracks at k instants.
        truths: (targets, k, 2), positions of the targets at these instants, in m; NaN if a target is
            absent.
        unreferenced_m: see `Judged`.

    Returns:
        The measures by name.
    """
    is_partial = np.isfinite(unreferenced_m)
    tracks = near_tracks(tracked, truths)[0] if is_partial else as_trajectories(tracked)
    lengths_s = [np.ptp(np.flatnonzero(there)) * PERIOD_S for there in np.isfinite(tracks[..., 0])]
    whole = trajectory_gospa(tracks, truths, CUTOFF_M, SWITCH_PENALTY_M)
    errors = track_errors(tracked, truths, unreferenced_m=unreferenced_m)
    return track_figures(errors) | {
        "tracks": float(len(tracks)),
        "track_length_s": float(np.mean(lengths_s)) if lengths_s else float("nan"),
        "trajectory_gospa_m": whole.total / np.sqrt(truths.shape[1]),
        **figures_of_whole_tracks(tracked, truths, unreferenced_m),
    }


def table_of(
    outputs: Mapping[str, Ragged],
    labels: Sequence[str],
    runs: Mapping[str, Judged],
    delay_s: float = 0.0,
) -> pd.DataFrame:
    """Tabulate measures by estimator and run; ignore outputs that arrived more than `delay_s` late."""
    rows = []
    for label in labels:
        for run, (name, at) in enumerate(runs.items()):
            tracked = tracks_at(*sets_of(outputs, label, run), at.time_ns, round(delay_s * 1e9))
            rows.append({"estimator": label, "run": name, **figures_of(tracked, *at[1:])})
    return pd.DataFrame(rows)


def means_of(table: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Compute the means over the runs, by estimator."""
    means: Any = table.drop(columns="run").groupby("estimator", sort=False).mean()
    return {str(label): row.to_dict() for label, row in means.iterrows()}


def nis_metrics(innovations: Sequence[Innovations]) -> dict[str, float]:
    """Compute the mean NIS per component by estimator and sensor, from tracks' likeliest detections."""
    return {
        f"{each.estimator}.nis_per_component.{each.case}": float(each.squared.sum() / each.degrees.sum())
        for each in innovations
        if each.degrees.sum()
    }


def measure_changes(
    table: pd.DataFrame, pairs: Sequence[tuple[str, str]], outcome: Outcome, case: str = ""
) -> None:
    """Measure the differences in quantities between the two estimators of each given pair."""
    for label, other in pairs:
        if {label, other} <= set(table["estimator"]):
            for quantity in [name for name in COMPARED if name in table]:
                change = difference(table, quantity, label, other)
                of = "-".join(filter(None, (other, case)))
                outcome.measure(f"{label}.change_in_{quantity}.{of}", change)


def difference(table: pd.DataFrame, quantity: str, label: str, other: str) -> Interval:
    """Compute the difference in a quantity between two estimators, over the runs."""
    by_run: Any = table.pivot_table(quantity, "run", "estimator", dropna=False, sort=False)
    return mean_interval(by_run[label] - by_run[other])
