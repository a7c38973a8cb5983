"""Outputs of a tracker after a scan: confirmed tracks, and associations with detections."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers, varying
from fuselog.replay.families.tracking.association.scanning import (
    ScanMemory,
)
from fuselog.replay.families.tracking.association.scans import Scans, take_scans
from fuselog.replay.families.tracking.association.tracker import believing, moving
from fuselog.replay.families.tracking.association.tracks import NEVER, Tracks
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian
from fuselog.replay.inference.model.bound_model import BoundModel


@varying(2)
class TrackOutputs(NamedTuple):
    """Outputs of a tracker after every scan.

    Attributes:
        end: (runs, 2), the numbers of rows of tracks and of associations that each run has filled.
        confirmed: (scans,), number of confirmed tracks; NEVER if the scan was too old to be used.
        approximated: (scans,), number of tracks in clusters too large for enumeration.
        turned_away: (scans,), number of detections that could not begin a track because all places for
            tracks were occupied.
        number, mean, covariance, probability, existence: (runs, rows, ...), values of confirmed tracks;
            `probability` has the probabilities of their modes.
        pair: (runs, rows, 3), track, scan and detection; associated: (runs, rows), their probability.
        white, factor: (runs, rows, 2) and (runs, rows, 2, 2), the whitened innovation of a pair in its
            most likely mode, and the Cholesky factor of the innovation covariance; a bearing is the
            first component.
    """

    end: Integers
    confirmed: Integers
    approximated: Integers
    turned_away: Integers
    number: Integers
    mean: Floats
    covariance: Floats
    probability: Floats
    existence: Floats
    pair: Integers
    associated: Floats
    white: Floats
    factor: Floats


class Rows(NamedTuple):
    """Rows for the estimates of one run, to be filled by `Steps.estimate`."""

    mean: Floats
    covariance: Floats
    probability: Floats


def writing_pairs(
    modes: int,
) -> Callable[[int, int, int, Tracks, TrackOutputs, ScanMemory], None]:
    """Make `write_pairs(run, scan, count, tracks, outputs, memory)`, which writes associations."""

    def write_pairs(
        run: int, scan: int, count: int, tracks: Tracks, outputs: TrackOutputs, memory: ScanMemory
    ) -> None:
        for place in range(tracks.used[run]):
            for detection in range(count if tracks.is_confirmed[run, place] else 0):
                if memory.probability[place, 1 + detection] > 0.0:
                    row = outputs.end[run, 1]
                    outputs.pair[run, row, 0] = tracks.number[run, place]
                    outputs.pair[run, row, 1], outputs.pair[run, row, 2] = scan, detection
                    outputs.associated[run, row] = memory.probability[place, 1 + detection]
                    likeliest = 0
                    for mode in range(1, modes):
                        likelihood = memory.likelihood[place, mode, detection]
                        if likelihood > memory.likelihood[place, likeliest, detection]:
                            likeliest = mode
                    white = memory.white[place, likeliest, detection]
                    factor = memory.spread[place, likeliest]
                    copy_gaussian(white, factor, outputs.white[run, row], outputs.factor[run, row])
                    outputs.end[run, 1] = row + 1

    return write_pairs


def writing_tracks(
    bound_model: BoundModel,
) -> Callable[[int, int, Tracks, TrackOutputs, ScanMemory], None]:
    """Make `write_tracks(run, scan, tracks, outputs, memory)`, which writes confirmed tracks."""
    belief_of, estimate = believing(bound_model), moving(bound_model).estimate

    def write_tracks(
        run: int, scan: int, tracks: Tracks, outputs: TrackOutputs, memory: ScanMemory
    ) -> None:
        belief = belief_of(run, tracks)
        rows = Rows(outputs.mean[run], outputs.covariance[run], outputs.probability[run])
        outputs.confirmed[scan] = 0
        for place in range(tracks.used[run]):
            if tracks.is_confirmed[run, place]:
                row = outputs.end[run, 0]
                outputs.number[run, row] = tracks.number[run, place]
                estimate(place, belief, rows, row, memory.motion)
                outputs.existence[run, row] = tracks.existence[run, place]
                outputs.end[run, 0] = row + 1
                outputs.confirmed[scan] += 1

    return write_tracks


BY_TRACK = ("number", "mean", "covariance", "probability", "existence")
BY_PAIR = ("associated", "white", "factor")


def blank_outputs(scans: Scans, runs: int, places: int, sizes: tuple[int, int, int]) -> TrackOutputs:
    """Allocate arrays for all possible outputs; pages that are never written use no memory."""
    modes, n, t = sizes
    counts = np.diff(scans.offsets)
    detections = np.add.reduceat(np.append(scans.end - scans.first, 0), scans.offsets[:-1])
    rows = places * int(counts.max(initial=0))
    pairs = places * int(np.where(counts > 0, detections, 0).max(initial=0))
    return TrackOutputs(
        end=np.zeros((runs, 2), np.int64),
        confirmed=np.full(len(scans.time_ns), NEVER),
        approximated=np.zeros(len(scans.time_ns), np.int64),
        turned_away=np.zeros(len(scans.time_ns), np.int64),
        number=np.empty((runs, rows), np.int64),
        mean=np.empty((runs, rows, n)),
        covariance=np.empty((runs, rows, t, t)),
        probability=np.empty((runs, rows, modes)),
        existence=np.empty((runs, rows)),
        pair=np.empty((runs, pairs, 3), np.int64),
        associated=np.empty((runs, pairs)),
        white=np.empty((runs, pairs, 2)),
        factor=np.empty((runs, pairs, 2, 2)),
    )


def of_last(scans: Scans, outputs: TrackOutputs) -> tuple[Scans, TrackOutputs]:
    """Return the last scan of one run, and its outputs."""
    last = len(scans.time_ns) - 1
    count, (end, paired) = max(int(outputs.confirmed[last]), 0), outputs.end[0]
    is_of_it = outputs.pair[0, :paired, 1] == last
    by_scan = {
        name: getattr(outputs, name)[last:] for name in ("confirmed", "approximated", "turned_away")
    }
    by_track = {name: getattr(outputs, name)[:, end - count : end] for name in BY_TRACK}
    return take_scans(scans, np.array([last])), TrackOutputs(
        end=np.array([[count, int(is_of_it.sum())]]),
        **by_scan,
        **by_track,
        pair=outputs.pair[:, :paired][:, is_of_it] - np.array([0, last, 0]),
        **{name: getattr(outputs, name)[:, :paired][:, is_of_it] for name in BY_PAIR},
    )
