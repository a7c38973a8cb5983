"""Smoothing of tracks: every state uses all detections of its track."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.families.tracking.association.track_smoothing import smooth_tracks
from fuselog.replay.families.tracking.targets import Targets


def check_smoothing(name: str, targets: Targets, errors: Sequence[str]) -> None:
    """Raise BadInput if tracks have sensor errors, or if their model has no single linear motion.

    Args:
        name: name of the estimator.
        targets: model of the targets.
        errors: the names of sensor errors in the states of tracks.
    """
    if errors:
        raise BadInput(
            f"estimator {name}: tracks with sensor errors cannot be smoothed; remove smoothed or the "
            "sensor errors"
        )
    if targets.bound_model.modes or not targets.bound_model.motion.linear:
        raise BadInput(
            f"estimator {name}: smoothed tracks require a model with one linear motion; remove "
            "smoothed, or use another model, or one of its modes"
        )


def smoothed(tracks: Ragged, targets: Targets) -> Ragged:
    """Smooth the states in a stream of tracks."""
    stream, size = tracks.stream, targets.bound_model.model.size
    run = run_of_rows(tracks.offsets)
    _, track = np.unique(
        np.stack([run, stream["track_id"].astype(np.int64)]), axis=1, return_inverse=True
    )
    mean, covariance = smooth_tracks(
        targets.bound_model,
        targets.parameters,
        track.ravel(),
        stream.publish_time_ns,
        stream["mean"],
        stream["covariance"].reshape(-1, size, size),
    )
    columns = {**stream.columns, "mean": mean, "covariance": covariance.reshape(-1, size**2)}
    return Ragged(replace(stream, columns=columns), tracks.offsets)
