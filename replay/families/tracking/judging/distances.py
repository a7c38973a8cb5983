"""Distances between tracks and targets' trajectories: trajectory GOSPA, HOTA and IDF1.

Tracks and trajectories are arrays (targets, steps, axes), with NaN at steps when the track or target is
absent.

Sources: Garcia-Fernandez, Rahmathullah, Svensson, "A metric on the space of finite sets of trajectories
for evaluation of multi-target tracking algorithms", IEEE TSP 68, 2020 (trajectory GOSPA); Luiten et al.,
"HOTA: a higher order metric for evaluating multi-object tracking", IJCV 129, 2021; Ristani et al.,
"Performance measures and a data set for multi-target, multi-camera tracking", ECCV 2016 (IDF1).
"""

from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.optimize import linear_sum_assignment, linprog

from fuselog.recorders.errors import BadInput

Floats = NDArray[np.float64]

# Largest number of assignments of estimates to truths that are enumerated at one step.
MOST_ASSIGNMENTS = 500
THRESHOLDS = np.arange(1, 20) / 20.0


class TrajectoryGospa(NamedTuple):
    """Trajectory GOSPA and its parts: total**order = localisation + missed + false + switching."""

    total: float
    localisation: float
    missed: float
    false: float
    switching: float


class Hota(NamedTuple):
    """HOTA and its parts, (thresholds,): hota**2 = detection * association."""

    hota: Floats
    detection: Floats
    association: Floats


def trajectory_gospa(
    estimates: ArrayLike,
    truths: ArrayLike,
    cutoff: float,
    switch_penalty: float,
    order: float = 2.0,
    *,
    exactly: bool = False,
) -> TrajectoryGospa:
    """Compute the trajectory GOSPA of tracks and trajectories, and its parts.

    If two estimates swap their truths, each costs the switch penalty to the power of the order; an
    estimate that begins or ceases to be paired costs half of this. By default, the metric is computed by
    linear programming, in which an estimate may be split among truths; with `exactly`, all assignments
    are enumerated step by step, which is feasible for small cases.

    Raises BadInput if the shapes do not match, a cutoff or penalty is not positive, the order is below
    1, or there are more than MOST_ASSIGNMENTS assignments to enumerate.

    Args:
        estimates: (n, steps, axes), NaN when a track is absent.
        truths: (m, steps, axes), NaN when a target is absent.
        cutoff: upper limit of a distance, in the unit of the points.
        switch_penalty: penalty of a switch, in the same unit.
        order: order of the sum, at least 1.
        exactly: whether to enumerate all assignments.
    """
    if not (0.0 < cutoff < np.inf and 0.0 < switch_penalty < np.inf and 1.0 <= order < np.inf):
        raise BadInput(
            f"cutoff {cutoff:g}, switch penalty {switch_penalty:g}, order {order:g}: cutoff and penalty "
            "must be positive, and the order at least 1"
        )
    first, second = _tracks(estimates, truths)
    distance = _distances(first, second)
    near = distance < cutoff  # at the cutoff, a pair costs as much as two unpaired points
    gain = np.where(near, np.where(near, distance, 0.0) ** order - cutoff**order, 0.0)
    half_switch = 0.5 * switch_penalty**order
    pair = _paired_exactly(gain, half_switch) if exactly else _paired(gain, half_switch)
    alone = 0.5 * cutoff**order
    paired = float((pair * near).sum())
    parts = (
        float((pair * np.where(near, distance, 0.0) ** order).sum()),
        alone * (_present(second).sum() - paired),
        alone * (_present(first).sum() - paired),
        half_switch * float(np.abs(np.diff(pair, axis=0)).sum()),
    )
    return TrajectoryGospa(max(sum(parts), 0.0) ** (1.0 / order), *map(float, parts))


def _paired(gain: Floats, half_switch: float) -> Floats:
    """Find the weights (steps, n, m) of pairs by linear programming.

    The weights w >= 0, whose rows and columns sum to at most 1, minimise the sum of w * gain (which is
    negative) and of half_switch * e over all changes e >= |w[k + 1] - w[k]|. Pairs that never reduce the
    cost have no weight.
    """
    steps, n, m = gain.shape
    row, column = np.nonzero((gain < 0.0).any(axis=0))
    pairs, weights = len(row), np.zeros(gain.shape)
    if pairs == 0:
        return weights
    members = np.append(row, n + column), np.tile(np.arange(pairs), 2)
    one_step = sparse.coo_matrix((np.ones(2 * pairs), members), (n + m, pairs))
    sums = sparse.kron(sparse.eye(steps), one_step)
    changes = sparse.kron(sparse.diags([-1.0, 1.0], [0, 1], (steps - 1, steps)), sparse.eye(pairs))
    size = sparse.eye((steps - 1) * pairs)
    bounds = sparse.bmat([[sums, None], [changes, -size], [-changes, -size]], format="csr")
    limits = np.concatenate([np.ones(sums.shape[0]), np.zeros(2 * (steps - 1) * pairs)])
    cost = np.append(gain[:, row, column].ravel(), np.full((steps - 1) * pairs, half_switch))
    found = linprog(cost, bounds, limits, method="highs")
    if not found.success:
        raise BadInput(f"the linear program of trajectory GOSPA has no solution: {found.message}")
    weights[:, row, column] = found.x[: steps * pairs].reshape(steps, pairs)
    return weights


def _paired_exactly(gain: Floats, half_switch: float) -> Floats:
    """Find the best pairs (steps, n, m), 0 or 1, by the shortest path through the assignments."""
    steps, n, m = gain.shape
    choices = _assignments(n, m)
    changes = np.abs(choices[:, None] - choices[None]).sum(axis=(2, 3)) * half_switch
    costs = np.einsum("sij,aij->sa", gain, choices)
    total, before = np.zeros(len(choices)), np.zeros((steps, len(choices)), np.int64)
    for step in range(steps):
        if step:
            ways = total[:, None] + changes
            before[step] = ways.argmin(axis=0)
            total = ways.min(axis=0)
        total = total + costs[step]
    chosen = int(total.argmin())
    pair = np.zeros(gain.shape)
    for step in range(steps - 1, -1, -1):
        pair[step] = choices[chosen]
        chosen = before[step, chosen]
    return pair


def _assignments(n: int, m: int) -> Floats:
    """List all one-to-one assignments (ways, n, m) between subsets of n estimates and m truths."""
    found = []
    for count in range(min(n, m) + 1):
        for rows in combinations(range(n), count):
            for columns in permutations(range(m), count):
                choice = np.zeros((n, m))
                choice[list(rows), list(columns)] = 1.0
                found.append(choice)
                if len(found) > MOST_ASSIGNMENTS:
                    raise BadInput(
                        f"{n} estimates and {m} truths have more than {MOST_ASSIGNMENTS} assignments; "
                        "use the linear program, exactly=False"
                    )
    return np.array(found)


def hota(
    estimates: ArrayLike,
    truths: ArrayLike,
    cutoff: float,
    thresholds: ArrayLike = THRESHOLDS,
    *,
    others: int = 0,
) -> Hota:
    """Compute the HOTA of tracks and trajectories at every threshold.

    The similarity of two points is max(0, 1 - distance / cutoff); they match if the similarity reaches
    the threshold. At each step, pairs are chosen that maximise similarity times the alignment of the
    trajectories over the whole span. The usual single figure is the mean over the thresholds 0.05, 0.10,
    ..., 0.95. Raises BadInput if the shapes do not match or the cutoff is not positive.

    Args:
        estimates: (n, steps, axes), NaN when a track is absent.
        truths: (m, steps, axes), NaN when a target is absent.
        cutoff: distance at which the similarity of two points becomes zero, in the unit of the points.
        thresholds: thresholds of the similarity, 0 to 1.
        others: number of points of additional tracks that never come within the cutoff of a target.
    """
    if not 0.0 < cutoff < np.inf:
        raise BadInput(f"cutoff {cutoff:g}: the cutoff must be positive")
    levels = np.atleast_1d(np.asarray(thresholds, float))
    first, second = _tracks(estimates, truths)
    similarity = np.nan_to_num(np.maximum(0.0, 1.0 - _distances(first, second) / cutoff))
    in_track, in_target = _present(first).sum(axis=1), _present(second).sum(axis=1)
    either = similarity.sum(axis=1, keepdims=True) + similarity.sum(axis=2, keepdims=True) - similarity
    shared = np.divide(similarity, either, out=np.zeros_like(similarity), where=either > 0).sum(axis=0)
    alignment = shared / np.maximum(in_track[:, None] + in_target - shared, 1.0)
    matches = np.zeros((len(levels), *shared.shape))
    for step in similarity:
        pair = linear_sum_assignment(alignment * step, maximize=True)
        least = np.maximum(levels[:, None] - np.finfo(float).eps, np.finfo(float).tiny)
        matches[:, *pair] += step[pair] >= least
    true_positive = matches.sum(axis=(1, 2))
    either_count = in_track.sum() + others + in_target.sum() - true_positive
    detection = true_positive / np.maximum(either_count, 1)
    jaccard = matches / np.maximum(in_track[:, None] + in_target - matches, 1)
    association = (matches * jaccard).sum(axis=(1, 2)) / np.maximum(true_positive, 1)
    return Hota(np.sqrt(detection * association), detection, association)


def idf1(estimates: ArrayLike, truths: ArrayLike, cutoff: float, *, others: int = 0) -> float:
    """Compute the IDF1 of tracks and trajectories: 2 IDTP / (all points of both).

    Each trajectory is assigned to at most one track. IDTP is the number of trajectory points that are
    closer than the cutoff to the assigned track; tracks are assigned such that IDTP is largest. The
    result is NaN if there are no points. Raises BadInput as `hota` does.

    Args:
        estimates: (n, steps, axes), NaN when a track is absent.
        truths: (m, steps, axes), NaN when a target is absent.
        cutoff: greatest distance of a pair, in the unit of the points.
        others: number of points of additional tracks that never come within the cutoff of a target.
    """
    if not 0.0 < cutoff < np.inf:
        raise BadInput(f"cutoff {cutoff:g}: the cutoff must be positive")
    first, second = _tracks(estimates, truths)
    together = (_distances(first, second) < cutoff).sum(axis=0)
    points = int(_present(first).sum() + _present(second).sum()) + others
    found = together[linear_sum_assignment(together, maximize=True)].sum()
    return 2.0 * float(found) / points if points else float("nan")


def _tracks(estimates: ArrayLike, truths: ArrayLike) -> tuple[Floats, Floats]:
    first, second = np.asarray(estimates, float), np.asarray(truths, float)
    if first.ndim != 3 or second.ndim != 3 or first.shape[1:] != second.shape[1:]:
        raise BadInput(
            f"tracks have shape {first.shape} and trajectories {second.shape}; both must be (targets, "
            "steps, axes) with the same steps and axes, NaN where a target is absent"
        )
    return first, second


def _present(tracks: Floats) -> NDArray[np.bool_]:
    """Test whether each target is present at each step: (targets, steps)."""
    return np.asarray(np.isfinite(tracks).all(axis=2))


def _distances(first: Floats, second: Floats) -> Floats:
    """Compute distances (steps, n, m), which are infinite if the track or the target is absent."""
    difference = first[:, None] - second[None]
    distance = np.sqrt((difference**2).sum(axis=3))
    return np.where(np.isnan(distance), np.inf, distance).transpose(2, 0, 1)
