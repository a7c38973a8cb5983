"""Association of detections with tracks: greedy, by the best assignment, or by all assignments.

An assignment gives each track at most one detection, which no other track has; detections without a
track are clutter. With Poisson clutter of density lambda, an assignment has the weight

    prod over detected tracks (P_D r_i g_ij / lambda)  *  prod over missed ones (1 - P_D P_G r_i),

where g_ij is the density of detection j under track i's prediction and r_i is the probability that track
i exists (1 in JPDA). All functions of this module read these weights (0 outside a gate) and fill the
probability that each track has each detection, which is 0 or 1 if a single assignment is chosen.

JPDA: Fortmann, Bar-Shalom, Scheffe, IEEE J. Oceanic Eng. 8(3), 1983. JIPDA: Musicki, Evans, IEEE TAES
40(3), 2004. Shortest augmenting paths: Crouse, IEEE TAES 52(4), 2016. Belief propagation: Williams, Lau,
IEEE TAES 50(4), 2014.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.errors import BadInput, choices
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.families.tracking.association.clusters import (
    NONE,
    AssociationMemory,
    Weights,
    choose,
    jpda,
    memory_for,
)


def nearest(
    weights: Weights, tracks: int, detections: int, probability: Floats, memory: AssociationMemory
) -> int:
    """Choose an assignment greedily: the most likely pair first, then the most likely remaining pair.

    Args:
        weights: weights of pairs and of misses.
        tracks: number of tracks; the arrays may be longer.
        detections: number of detections; the arrays may be longer.
        probability: (tracks, 1 + detections), filled: 1 for an assigned pair, and 1 in the first
            column for a track without a detection.
        memory: scratch memory.

    Returns:
        0, because no cluster is approximated.
    """
    memory.is_seen[:detections] = False
    memory.column_of[:tracks] = NONE
    while True:
        best, chosen_row, chosen_column = 1.0, NONE, NONE
        for row in range(tracks):
            for column in range(detections):
                gain = weights.detected[row, column] / weights.missed[row]
                if gain > best and memory.column_of[row] == NONE and not memory.is_seen[column]:
                    best, chosen_row, chosen_column = gain, row, column
        if chosen_row == NONE:
            break
        memory.column_of[chosen_row] = chosen_column
        memory.is_seen[chosen_column] = True
    for row in range(tracks):
        choose(row, memory.column_of[row], detections, probability)
    return 0


def hungarian(
    weights: Weights, tracks: int, detections: int, probability: Floats, memory: AssociationMemory
) -> int:
    """Choose the assignment with the greatest weight by shortest augmenting paths (Crouse, fig. 3).

    Column j of the assignment problem is detection j, and column detections + i is a miss of track i.

    Args:
        weights: weights of pairs and of misses.
        tracks: number of tracks; the arrays may be longer.
        detections: number of detections; the arrays may be longer.
        probability: (tracks, 1 + detections), filled as by `nearest`.
        memory: scratch memory.

    Returns:
        0, because no cluster is approximated.
    """
    columns = detections + tracks
    memory.price[:columns], memory.row_of[:columns] = 0.0, NONE
    memory.potential[:tracks], memory.column_of[:tracks] = 0.0, NONE
    for first in range(tracks):
        memory.distance[:columns], memory.is_done[:columns] = np.inf, False
        row, reached, sink = first, 0.0, NONE
        while sink == NONE:
            closest = NONE
            for column in range(columns):
                if memory.is_done[column]:
                    continue
                cost = cost_of(weights, row, column, detections)
                length = reached + cost - memory.potential[row] - memory.price[column]
                if length < memory.distance[column]:
                    memory.distance[column], memory.before[column] = length, row
                if closest == NONE or memory.distance[column] < memory.distance[closest]:
                    closest = column
            reached = memory.distance[closest]
            memory.is_done[closest] = True
            if memory.row_of[closest] == NONE:
                sink = closest
            else:
                row = memory.row_of[closest]
        memory.potential[first] += reached
        for column in range(columns):
            if memory.is_done[column] and column != sink:
                memory.potential[memory.row_of[column]] += reached - memory.distance[column]
                memory.price[column] -= reached - memory.distance[column]
        column = sink
        while True:
            row = memory.before[column]
            memory.row_of[column] = row
            column, memory.column_of[row] = memory.column_of[row], column
            if row == first:
                break
    for row in range(tracks):
        column = memory.column_of[row]
        choose(row, column if column < detections else NONE, detections, probability)
    return 0


def cost_of(weights: Weights, row: int, column: int, detections: int) -> float:
    """Compute the cost of a pair relative to a miss: minus the log of the ratio of the two weights.

    It is infinite if the pair is impossible.
    """
    if column >= detections:
        return 0.0 if column - detections == row else np.inf
    cost: float = -np.log(weights.detected[row, column] / weights.missed[row])
    return cost


# (weights, tracks, detections, probability, memory), as in `nearest`.
Associate = Callable[[Weights, int, int, Floats, AssociationMemory], int]
ASSOCIATIONS: dict[str, Associate] = {"nearest": nearest, "hungarian": hungarian, "jpda": jpda}


def existence_after(existence: float, none: float, detection_probability: float) -> float:
    """Compute the existence of a track after a scan; `none` is the probability of a miss.

    This is (15) of Musicki and Evans: the more probable a detection was, the more a miss lowers the
    existence.
    """
    missed = 1.0 - detection_probability
    if_missed = missed * existence / (1.0 - detection_probability * existence)
    return 1.0 - none + none * if_missed


def marginals(detected: ArrayLike, missed: ArrayLike, association: str = "jpda") -> Floats:
    """Compute each track's probabilities (tracks, 1 + n) of no detection and of each detection.

    Args:
        detected: (tracks, n), the weights of pairs; 0 outside a gate.
        missed: (tracks,), the weights of misses.
        association: one of ASSOCIATIONS; "nearest" and "hungarian" choose one assignment.

    Raises BadInput if the weights are invalid, or if the association is unknown.

    A detection between two tracks:

    >>> marginals([[3.0], [1.0]], [1.0, 1.0])
    array([[0.4, 0.6],
           [0.8, 0.2]])
    """
    weights = Weights(np.array(detected, float, ndmin=2), np.array(missed, float))
    tracks, detections = weights.detected.shape
    finite = np.isfinite(weights.detected).all() and np.isfinite(weights.missed).all()
    if weights.missed.shape != (tracks,) or not finite or (weights.detected < 0.0).any():
        raise BadInput(
            "weights must be finite, not negative, and of shapes (tracks, detections) for pairs and "
            "(tracks,) for misses"
        )
    if (weights.missed <= 0.0).any():
        raise BadInput(
            "the weights of misses must be positive, because no track is detected with certainty"
        )
    if association not in ASSOCIATIONS:
        raise BadInput(f"no association '{association}'; {choices(association, ASSOCIATIONS)}")
    probability = np.empty((tracks, 1 + detections))
    memory = memory_for(tracks, detections)
    _compiled(association)(weights, tracks, detections, probability, memory)
    return probability


@cache
def _compiled(association: str) -> Associate:
    return compiled(ASSOCIATIONS[association])
