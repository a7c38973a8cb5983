"""Holds the tracks of many targets in columns, and takes one out.

A track is a Gaussian for each of its model's modes, with the modes' probabilities; a model of one motion
has one mode, which is certain.
"""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers, varying
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian

NEVER = -1


@varying(2)
class Tracks(NamedTuple):
    """Holds the tracks of all runs, the oldest first: axes run and place, of which `used` are taken.

    Attributes:
        used, met: (runs,), how many there are, and ever were, which numbers them.
        time_ns: (runs,), of all states; NEVER before the first scan.
        number, existence, is_confirmed: (runs, places).
        mean, covariance: (runs, places, modes, ...).
        mode, log_mode: (runs, places, modes), the modes' probabilities, and their logarithms.
        hits, chances: (runs, places), scans since its birth in which it was, or could have been, seen.
        score, best_score: (runs, places), the log-likelihood ratio since its birth, and its highest.
        seen_ns: (runs, places), when a sensor that begins tracks saw it last.
        updated_ns: (runs, places, sensors), when each sensor updated it last.
        shared_mean, shared_covariance: (runs, ...), of what all share:
            `fuselog.replay.families.tracking.association.shared_bias`.
    """

    used: Integers
    met: Integers
    time_ns: Integers
    number: Integers
    mean: Floats
    covariance: Floats
    mode: Floats
    log_mode: Floats
    existence: Floats
    is_confirmed: Booleans
    hits: Integers
    chances: Integers
    score: Floats
    best_score: Floats
    seen_ns: Integers
    updated_ns: Integers
    shared_mean: Floats
    shared_covariance: Floats


def no_tracks(
    runs: int, places: int, sizes: tuple[int, int, int], sensors: int, shared: Floats
) -> Tracks:
    """Return runs in which nothing was met yet, with room for so many tracks.

    `sizes` are those of the modes, of the state and of its tangent space; `shared` (k, k) is how
    uncertain what all tracks share is at first.

    Args:
        runs: how many.
        places: for how many tracks of each run there is room.
        sizes: of the modes, of the state and of its tangent space.
        sensors: how many there are.
        shared: (k, k), the covariance of what all tracks share.

    Returns:
        The tracks, of which none is used.
    """
    modes, n, t = sizes
    return Tracks(
        used=np.zeros(runs, np.int64),
        met=np.zeros(runs, np.int64),
        time_ns=np.full(runs, NEVER),
        number=np.zeros((runs, places), np.int64),
        mean=np.zeros((runs, places, modes, n)),
        covariance=np.zeros((runs, places, modes, t, t)),
        mode=np.ones((runs, places, modes)),
        log_mode=np.zeros((runs, places, modes)),
        existence=np.zeros((runs, places)),
        is_confirmed=np.zeros((runs, places), bool),
        hits=np.zeros((runs, places), np.int64),
        chances=np.zeros((runs, places), np.int64),
        score=np.zeros((runs, places)),
        best_score=np.zeros((runs, places)),
        seen_ns=np.zeros((runs, places), np.int64),
        updated_ns=np.zeros((runs, places, sensors), np.int64),
        shared_mean=np.zeros((runs, len(shared))),
        shared_covariance=np.tile(shared, (runs, 1, 1)),
    )


def drop(run: int, place: int, tracks: Tracks) -> None:
    """Take a track out; those after it move up."""
    tracks.used[run] -= 1
    for at in range(place, tracks.used[run]):
        for counts in (tracks.number, tracks.hits, tracks.chances, tracks.seen_ns):
            counts[run, at] = counts[run, at + 1]
        for values in (tracks.existence, tracks.score, tracks.best_score):
            values[run, at] = values[run, at + 1]
        tracks.is_confirmed[run, at] = tracks.is_confirmed[run, at + 1]
        for mode in range(tracks.mode.shape[2]):
            tracks.mode[run, at, mode] = tracks.mode[run, at + 1, mode]
            tracks.log_mode[run, at, mode] = tracks.log_mode[run, at + 1, mode]
            mean, covariance = tracks.mean[run, at, mode], tracks.covariance[run, at, mode]
            after = tracks.mean[run, at + 1, mode], tracks.covariance[run, at + 1, mode]
            copy_gaussian(after[0], after[1], mean, covariance)
        tracks.updated_ns[run, at] = tracks.updated_ns[run, at + 1]


def expected(run: int, place: int, component: int, tracks: Tracks) -> float:
    """Return a linear component of a track's mean over all modes."""
    total = 0.0
    for mode in range(tracks.mode.shape[2]):
        total += tracks.mode[run, place, mode] * tracks.mean[run, place, mode, component]
    return total


def are_near(
    run: int, place: int, other: int, components: tuple[int, int], within: float, tracks: Tracks
) -> bool:
    """Tell whether two components of two tracks' means, together, differ by less."""
    x, y = components
    is_near: bool = (
        np.hypot(
            expected(run, place, x, tracks) - expected(run, other, x, tracks),
            expected(run, place, y, tracks) - expected(run, other, y, tracks),
        )
        < within
    )
    return is_near
