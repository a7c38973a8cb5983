"""Confirmation and end of tracks by existence, hits or score, for any association.

    existence   the probability that the target exists (Musicki, Evans, IEEE TAES 40(3), 2004)
    hits        detections in M of the first N chances, see Bar-Shalom, Li, Kirubarajan, 2001, 7.8
    score       the log-likelihood ratio of a target and clutter in Wald's sequential test: Blackman,
                Popoli, Design and Analysis of Modern Tracking Systems, 1999, 6.2

All three also end a track that has been silent for too long.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.families.tracking.association.association import existence_after
from fuselog.replay.families.tracking.association.clusters import Weights
from fuselog.replay.families.tracking.association.tracks import Tracks

# A miss does not count against a young track if its detection was less probable than this.
CHANCE = 0.5


class Management(NamedTuple):
    """Functions that manage tracks.

    Attributes:
        wait: (run, place, duration_s, tracks, parameters); applies the effect of elapsed time.
        judge: (run, place, evidence, tracks, parameters); applies the effect of a scan, and may confirm
            a track.
        is_over: (run, place, tracks, parameters) -> whether a track ends.
    """

    wait: Callable[[int, int, float, Tracks, Settings], None]
    judge: Callable[[int, int, "Evidence", Tracks, Settings], None]
    is_over: Callable[[int, int, Tracks, Settings], bool]


class Evidence(NamedTuple):
    """Evidence of a scan for one track.

    Attributes:
        detectable: probability of a detection in the gate, if the target exists.
        probability: (1 + detections,), the probabilities of no detection and of each detection, see
            `fuselog.replay.families.tracking.association.association`.
        weights: weights of all tracks.
    """

    detectable: float
    probability: Floats
    weights: Weights


def is_silent(run: int, place: int, tracks: Tracks, p: Settings) -> bool:
    """Test whether the track has not been detected for too long by any sensor that begins tracks."""
    silent_s = (tracks.time_ns[run] - tracks.seen_ns[run, place]) * 1e-9
    longest_s: float = p.silence_s if tracks.is_confirmed[run, place] else p.tentative_silence_s
    is_over: bool = silent_s > longest_s
    return is_over


def wait_unchanged(run: int, place: int, duration_s: float, tracks: Tracks, p: Settings) -> None:
    """Leave a track unchanged, because elapsed time has no effect."""
    return


def confirm(run: int, place: int, tracks: Tracks) -> None:
    """Confirm a track, and set its existence to 1."""
    tracks.is_confirmed[run, place], tracks.existence[run, place] = True, 1.0


# Existence


def may_vanish(run: int, place: int, duration_s: float, tracks: Tracks, p: Settings) -> None:
    """Lower the existence by the probability that the target has vanished in the elapsed time."""
    tracks.existence[run, place] *= np.exp(-duration_s / p.survival_s)


def judge_existence(run: int, place: int, evidence: Evidence, tracks: Tracks, p: Settings) -> None:
    """Update the existence by Bayes' rule; below `keeping_existence`, a track is no longer confirmed."""
    before, none = tracks.existence[run, place], evidence.probability[0]
    tracks.existence[run, place] = existence_after(before, none, evidence.detectable)
    needed = p.keeping_existence if tracks.is_confirmed[run, place] else p.confirming_existence
    tracks.is_confirmed[run, place] = tracks.existence[run, place] >= needed


def does_not_exist(run: int, place: int, tracks: Tracks, p: Settings) -> bool:
    """Test whether a track is silent or improbable."""
    return is_silent(run, place, tracks, p) or tracks.existence[run, place] < p.ending_existence


# Hits


def judge_hits(run: int, place: int, evidence: Evidence, tracks: Tracks, p: Settings) -> None:
    """Update the numbers of chances and hits; a miss is a chance only if a detection was probable."""
    is_hit = evidence.probability[0] < 0.5
    if is_hit or evidence.detectable >= CHANCE:
        tracks.chances[run, place] += 1
    if is_hit:
        tracks.hits[run, place] += 1
    if tracks.hits[run, place] >= p.hits_needed:
        confirm(run, place, tracks)


def was_hit_too_seldom(run: int, place: int, tracks: Tracks, p: Settings) -> bool:
    """Test whether a track is silent, or had too few hits in its first chances."""
    is_young = not tracks.is_confirmed[run, place]
    return is_silent(run, place, tracks, p) or (is_young and tracks.chances[run, place] >= p.chances)


# Score


def judge_score(run: int, place: int, evidence: Evidence, tracks: Tracks, p: Settings) -> None:
    """Add sum_j b_j log(w_j / b_j), with the weights w of a target that exists.

    For a single assignment, the sum is the log of its weight; for all assignments of one track, it is
    log sum_j w_j.
    """
    weights, existence = evidence.weights, tracks.existence[run, place]
    gain = 0.0
    for column in range(len(evidence.probability)):
        probability = evidence.probability[column]
        if probability > 0.0:
            weight = 1.0 - evidence.detectable
            if column > 0:
                weight = weights.detected[place, column - 1] / existence
            gain += probability * np.log(weight / probability)
    tracks.score[run, place] += gain
    if tracks.score[run, place] > tracks.best_score[run, place]:
        tracks.best_score[run, place] = tracks.score[run, place]
    if tracks.score[run, place] >= np.log((1.0 - p.missed_confirmation) / p.false_confirmation):
        confirm(run, place, tracks)


def has_lost_its_score(run: int, place: int, tracks: Tracks, p: Settings) -> bool:
    """Test whether a track is silent or has a score far below 0 or, if confirmed, below its maximum."""
    begun = tracks.best_score[run, place] if tracks.is_confirmed[run, place] else 0.0
    lowest = np.log(p.missed_confirmation / (1.0 - p.false_confirmation))
    return is_silent(run, place, tracks, p) or tracks.score[run, place] - begun <= lowest


MANAGEMENTS = {
    "existence": Management(may_vanish, judge_existence, does_not_exist),
    "hits": Management(wait_unchanged, judge_hits, was_hit_too_seldom),
    "score": Management(wait_unchanged, judge_score, has_lost_its_score),
}
