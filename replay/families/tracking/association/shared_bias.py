"""Estimation of sensor errors that all tracks share, as part of every track's state.

Given the errors b, targets are independent, so a joint Gaussian of all targets and b consists of a
Gaussian of b and, for every track, a Gaussian of its target given b. Each track has a Gaussian of its
target and b; the marginal of b is the same in all tracks. The information of a scan about b is summed
over the tracks,

    B+^-1 = B^-1 + sum_i (B_i^-1 - B^-1),   B+^-1 b+ = B^-1 b + sum_i (B_i^-1 b_i - B^-1 b),

where b and B are the mean and covariance of the errors, and b_i and B_i are their mean and covariance
after the update of track i only. Then every track gets the new marginal and keeps its conditional
Gaussian of the target given b. The states must not contain rotations. For constant b and certain
associations, this is the joint Kalman filter.
"""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, varying
from fuselog.replay.families.tracking.association.tracks import Tracks
from fuselog.replay.inference.linear_algebra.gaussian import invert


@varying(0, is_updated=1)
class Pool(NamedTuple):
    """Scratch memory for k shared errors: matrices (k, k), vectors (k,), and the gain (t, k) of a track.

    `is_updated` (tracks,) marks the tracks that a scan has updated.
    """

    factor: Floats
    before: Floats
    inverse: Floats
    information: Floats
    vector: Floats
    column: Floats
    gain: Floats
    is_updated: Booleans


def pool_of(shared: int, tangent: int, places: int) -> Pool:
    """Make memory for the given numbers of errors, tangent components and tracks."""
    square = (shared, shared)
    return Pool(
        np.empty(square),
        np.empty(square),
        np.empty(square),
        np.empty(square),
        np.empty(shared),
        np.empty(shared),
        np.empty((tangent, shared)),
        np.empty(places, bool),
    )


def pool_errors(run: int, first: int, tracks: Tracks, pool: Pool) -> None:
    """Fuse the confirmed tracks' estimates of the shared errors, and update all tracks of a run.

    The shared errors are the components from index `first` in the state of every track. If associations
    are so ambiguous that the fused information is not positive definite, the shared errors are not
    changed.
    """
    mean, covariance = tracks.shared_mean[run], tracks.shared_covariance[run]
    size = len(mean)
    invert(covariance, pool.before, pool.factor)
    for i in range(size):
        pool.vector[i] = 0.0
        for j in range(size):
            pool.information[i, j] = pool.before[i, j]
            pool.vector[i] += pool.before[i, j] * mean[j]
    for place in range(tracks.used[run]):
        if not (tracks.is_confirmed[run, place] and pool.is_updated[place]):
            continue
        own = tracks.covariance[run, place, 0, first : first + size, first : first + size]
        if not invert(own, pool.inverse, pool.factor):
            continue
        for i in range(size):
            for j in range(size):
                pool.information[i, j] += pool.inverse[i, j] - pool.before[i, j]
                learnt = pool.inverse[i, j] * tracks.mean[run, place, 0, first + j]
                pool.vector[i] += learnt - pool.before[i, j] * mean[j]
    if invert(pool.information, pool.inverse, pool.factor):
        for i in range(size):
            mean[i] = 0.0
            for j in range(size):
                covariance[i, j] = pool.inverse[i, j]
                mean[i] += pool.inverse[i, j] * pool.vector[j]
    for place in range(tracks.used[run]):
        conform(run, place, first, tracks, pool)


def conform(run: int, place: int, first: int, tracks: Tracks, pool: Pool) -> None:
    """Set the shared errors in a track; keep its conditional estimate of the target given the errors."""
    shared_mean, shared = tracks.shared_mean[run], tracks.shared_covariance[run]
    mean, covariance = tracks.mean[run, place, 0], tracks.covariance[run, place, 0]
    size, t = len(shared_mean), len(covariance)
    last, gain = first + size, pool.gain
    if not invert(covariance[first:last, first:last], pool.inverse, pool.factor):
        return
    for i in range(size):
        pool.column[i] = shared_mean[i] - mean[first + i]
        for j in range(size):
            pool.before[i, j] = shared[i, j] - covariance[first + i, first + j]
    for row in range(t):
        for i in range(size):
            gain[row, i] = 0.0
            for j in range(size):
                gain[row, i] += covariance[row, first + j] * pool.inverse[j, i]
    for row in range(t):
        for i in range(size):
            mean[row] += gain[row, i] * pool.column[i]
        for column in range(row + 1):
            entry = covariance[row, column]
            for i in range(size):
                for j in range(size):
                    entry += gain[row, i] * pool.before[i, j] * gain[column, j]
            covariance[row, column] = covariance[column, row] = entry
