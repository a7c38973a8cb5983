"""Smooths a tracker's tracks: says at the end what all detections say of every state."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.replaying.estimator import Recursive
from replay.engine.streams.blocks import Block, Ragged, join
from replay.estimators.tracking.targets import Targets
from replay.inference.association.track_smoothing import smooth_tracks


class TrackSmootherState(NamedTuple):
    """Holds the tracker's state, and its outputs by block."""

    tracker: Any
    outputs: tuple[list[Ragged], ...]


def smoothing_tracks(tracker: Recursive, targets: Targets) -> Recursive:
    """Return the tracker, which keeps what it says until the end and says its tracks smoothed.

    Raises BadInput where the motion of its targets is not linear, or they have several.
    """
    if targets.stage.modes or not targets.stage.motion.linear:
        raise BadInput(
            f"estimator {tracker.name}: smoothed tracks need a model with one linear motion; leave "
            "out smoothed, or take another model, or one of its modes"
        )

    def start(static: Mapping[str, Ragged]) -> TrackSmootherState:
        return TrackSmootherState(tracker.start(dict(static)), ())

    def run(state: TrackSmootherState, block: Block) -> tuple[TrackSmootherState, list[Ragged]]:
        after, outputs = tracker.run(state.tracker, block)
        return TrackSmootherState(after, (*state.outputs, outputs)), []

    def finish(state: TrackSmootherState) -> list[Ragged]:
        outputs = [join(parts) for parts in zip(*filter(None, state.outputs), strict=True)]
        return [
            _smoothed(each, targets) if each.stream.topic.endswith("/track") else each
            for each in outputs
        ]

    return replace(tracker, start=start, run=run, finish=finish, out_of_sequence=_refuse_out_of_sequence)


def _refuse_out_of_sequence(_: int) -> Recursive:
    raise BadInput(
        "smoothed tracks use later detections in any case; replay them in the order of the stamps, or "
        "with --late wait:SECONDS"
    )


def _smoothed(tracks: Ragged, targets: Targets) -> Ragged:
    """Return the stream of tracks with smoothed states."""
    stream, size = tracks.stream, targets.stage.model.size
    run = np.repeat(np.arange(tracks.runs), np.diff(tracks.offsets))
    _, track = np.unique(
        np.stack([run, stream["track_id"].astype(np.int64)]), axis=1, return_inverse=True
    )
    mean, covariance = smooth_tracks(
        targets.stage,
        targets.parameters,
        track.ravel(),
        stream.publish_time_ns,
        stream["mean"],
        stream["covariance"].reshape(-1, size, size),
    )
    columns = {**stream.columns, "mean": mean, "covariance": covariance.reshape(-1, size**2)}
    return Ragged(replace(stream, columns=columns), tracks.offsets)
