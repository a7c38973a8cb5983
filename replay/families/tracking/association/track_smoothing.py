"""Backward smoothing of tracks: each estimate also uses later detections.

The association of detections with tracks is not changed. Given this association, the states of a track
are a chain of Gaussians connected by one motion, and `fuselog.replay.inference.smoothing.backward_pass`
smooths them.
"""

from functools import partial

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers, Settings
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.functions import ModelFunction
from fuselog.replay.inference.run.recursion import EstimateRows
from fuselog.replay.inference.smoothing.backward_pass import (
    FOREVER_NS,
    Nodes,
    Piece,
    Smoothed,
    back_memory,
    backward_pass_over_runs,
    no_later,
)


def smooth_tracks(
    bound_model: BoundModel,
    parameters: Settings,
    track: Integers,
    time_ns: Integers,
    mean: Floats,
    covariance: Floats,
) -> tuple[Floats, Floats]:
    """Smooth the filtered estimates of tracks: means (n, size) and covariances (n, size, size).

    The motion of the model must be linear and must not have a control.

    Args:
        bound_model: the bound model of the targets.
        parameters: the parameters that the functions of the model read.
        track: (n,), index of the track of each estimate.
        time_ns: (n,), increasing in each track.
        mean: (n, size), filtered.
        covariance: (n, size, size), filtered.
    """
    order = np.argsort(track, kind="stable")
    numbers, first = np.unique(track[order], return_index=True)
    offsets = np.append(first, len(track))
    nodes = _nodes(bound_model, parameters, offsets, time_ns[order], mean[order], covariance[order])
    runs, n = len(numbers), bound_model.model.size
    smoothed = EstimateRows(
        offsets[1:].copy(),
        np.empty_like(nodes.time_ns),
        np.empty(mean.shape),
        np.empty(covariance.shape),
    )
    later, filled = no_later(runs, n, n), Smoothed(offsets[1:], offsets[:-1], FOREVER_NS, smoothed)
    go_back, memory = backward_pass_over_runs(bound_model.model.kinds), partial(back_memory, n, n)
    go_back(runs, Piece(nodes, offsets), later, filled, scratch=memory)
    back = np.argsort(order)
    return smoothed.mean[back], smoothed.covariance[back]


def _nodes(
    bound_model: BoundModel,
    parameters: Settings,
    offsets: Integers,
    time_ns: Integers,
    mean: Floats,
    covariance: Floats,
) -> Nodes:
    """Make the nodes of the estimates, with the transition from each node's predecessor.

    The first node of a track has no predecessor.
    """
    duration_s = np.diff(time_ns, prepend=time_ns[:1]) * 1e-9
    duration_s[offsets[:-1]] = 0.0
    before, spread = np.roll(mean, 1, axis=0), np.roll(covariance, 1, axis=0)
    transition, noise = _motion(bound_model, parameters, before, duration_s)
    cross = spread @ transition.transpose(0, 2, 1)
    predicted = transition @ cross + noise
    gain = np.asarray(np.linalg.solve(predicted, cross.transpose(0, 2, 1)), float).transpose(0, 2, 1)
    return Nodes(
        end=offsets[1:].copy(),
        time_ns=time_ns,
        mean=mean,
        covariance=covariance,
        predicted=np.einsum("nij,nj->ni", transition, before),
        slope=np.zeros_like(mean),
        gain=gain,
        rest=spread - gain @ cross.transpose(0, 2, 1),
    )


def _motion(
    bound_model: BoundModel, parameters: Settings, mean: Floats, duration_s: Floats
) -> tuple[Floats, Floats]:
    """Compute transition and noise matrices (n, size, size) of a linear motion over each duration."""
    size, count, state = bound_model.model.size, len(duration_s), tuple(mean.T)
    assert bound_model.motion.noise is not None
    transition, noise = np.empty((count, size, size)), np.zeros((count, size, size))
    for column, unit in enumerate(np.eye(size)):
        moved = bound_model.motion.move(tuple(unit), (), duration_s, parameters)
        for row, entry in enumerate(moved):
            transition[:, row, column] = entry
    noise_of: ModelFunction = bound_model.motion.noise  # for many durations together
    lower = noise_of(state, duration_s, parameters)
    rows, columns = np.diag_indices(size) if len(lower) == size else np.tril_indices(size)
    for i, j, entry in zip(rows.tolist(), columns.tolist(), lower, strict=True):
        noise[:, i, j] = noise[:, j, i] = entry
    return transition, noise
