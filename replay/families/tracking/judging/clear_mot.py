"""Pairs of targets and tracks as in CLEAR MOT: a pair is kept while it is within the cutoff.

Source: Bernardin, Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT
metrics", EURASIP J. on Image and Video Processing, 2008, section 2.1. As in motmetrics, a missed target
keeps its last track, so a target that returns with the same track has not switched.
"""

from collections.abc import Sequence

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers

NONE = -1


def clear_mot(tracks: Sequence[tuple[Integers, Floats]], truths: Floats, cutoff: float) -> Integers:
    """Pair targets with tracks at k instants.

    Args:
        tracks: at each instant, the numbers (n,) of the tracks and their positions (n, axes).
        truths: (targets, k, axes), NaN when a target is absent.
        cutoff: greatest distance of a pair, in the unit of the points.

    Returns:
        (targets, k), the number of the track of each target, or NONE.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    targets, instants, _ = truths.shape
    pairs = np.full((targets, instants), NONE)
    before = np.full(targets, NONE)
    for instant, (numbers, places) in enumerate(tracks):
        away = np.linalg.norm(truths[:, instant, None] - places[None], axis=2)
        is_near = away < cutoff
        for target in np.flatnonzero(is_near.any(axis=1)):
            kept = np.flatnonzero(is_near[target] & (numbers == before[target]))
            if len(kept):
                pairs[target, instant] = before[target]
                is_near[target], is_near[:, kept] = False, False
        rows, columns = np.flatnonzero(is_near.any(axis=1)), np.flatnonzero(is_near.any(axis=0))
        left = np.ix_(rows, columns)
        # the greatest number of pairs, and among these the smallest distances
        costs = np.where(is_near[left], away[left], 2.0 * cutoff * (1 + min(left[0].size, left[1].size)))
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if is_near[left][row, column]:
                pairs[rows[row], instant] = numbers[columns[column]]
        before = np.where(pairs[:, instant] != NONE, pairs[:, instant], before)
    return pairs


def switches_and_breaks(pairs: Integers, present: Booleans) -> tuple[int, int]:
    """Count how often targets switch to another track, and how often they are lost temporarily.

    Args:
        pairs: (targets, k), from `clear_mot`.
        present: (targets, k), whether the target is present; an absent target is not lost.
    """
    switches = breaks = 0
    for track, is_there in zip(pairs, present, strict=True):
        own = track[is_there]
        followed = np.flatnonzero(own != NONE)
        switches += int(np.count_nonzero(np.diff(own[followed])))
        breaks += int(np.count_nonzero(np.diff(followed) > 1))
    return switches, breaks
