"""Tracks of many targets in columns.

A track has a Gaussian and a probability for each mode of its model; a model with one motion has one mode
of probability 1.
"""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers, varying
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian

NEVER = -1


@varying(2)
class Tracks(NamedTuple):
    """Tracks of all runs, oldest first; axes are run and place; the first `used` places are occupied.

    Attributes:
        used, met: (runs,), number of current tracks, and number of all tracks so far, from which new
            tracks get their number.
        time_ns: (runs,), stamp of all states; NEVER before the first scan.
        number, existence, is_confirmed: (runs, places).
        mean, covariance: (runs, places, modes, ...).
        mode, log_mode: (runs, places, modes), the modes' probabilities, and their logarithms.
        hits, chances: (runs, places), numbers of scans since the track's birth that detected it, and
            that could have detected it.
        score, best_score: (runs, places), the log-likelihood ratio of a track since its birth, and the
            maximum of this ratio.
        seen_ns: (runs, places), time at which a sensor that begins tracks last detected the track.
        updated_ns: (runs, places, sensors), time at which each sensor last updated the track.
        shared_mean, shared_covariance: (runs, ...), mean and covariance of the errors that all tracks
            share: `fuselog.replay.families.tracking.association.shared_bias`.
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
    """Make empty tracks.

    Args:
        runs: number of runs.
        places: greatest number of tracks of each run.
        sizes: number of modes, and sizes of the state and of its tangent space.
        sensors: number of sensors.
        shared: (k, k), the initial covariance of the errors that all tracks share.

    Returns:
        Tracks without any occupied place.
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
    """Remove a track, and shift all later tracks by one place."""
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
    """Compute the mean of a linear component of a track over all modes."""
    total = 0.0
    for mode in range(tracks.mode.shape[2]):
        total += tracks.mode[run, place, mode] * tracks.mean[run, place, mode, component]
    return total


def are_near(
    run: int, place: int, other: int, components: tuple[int, int], within: float, tracks: Tracks
) -> bool:
    """Test whether two tracks are closer than a limit in two components of their means."""
    x, y = components
    is_near: bool = (
        np.hypot(
            expected(run, place, x, tracks) - expected(run, other, x, tracks),
            expected(run, place, y, tracks) - expected(run, other, y, tracks),
        )
        < within
    )
    return is_near
