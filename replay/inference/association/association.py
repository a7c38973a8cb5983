"""Which detection of a scan is of which track: the nearest, the best map, or all maps, weighted.

A map sends every track to a detection of its own or to none; the detections left over are clutter. With
Poisson clutter of density lambda it has the weight

    prod over detected tracks (P_D r_i g_ij / lambda)  *  prod over missed ones (1 - P_D P_G r_i),

where g_ij is the density of detection j about track i's prediction and r_i how probable it is that
track i exists (1 in JPDA). All of what is here takes these weights, 0 outside a gate, and fills in how
probable it is that each track has each detection: 0 or 1 where one map is chosen.

JPDA: Fortmann, Bar-Shalom, Scheffe, IEEE J. Oceanic Eng. 8(3), 1983. JIPDA: Musicki, Evans, IEEE TAES
40(3), 2004. Shortest augmenting paths: Crouse, IEEE TAES 52(4), 2016. Belief propagation: Williams, Lau,
IEEE TAES 50(4), 2014.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from recorders.errors import BadInput, choices
from replay.engine.arrays import Booleans, Floats, Function, Integers, varying
from replay.engine.compiling.compile import compiled

# Clusters in which both tracks and detections are more than this are left to belief propagation.
MOST_ENUMERATED = 12
PROPAGATED = 1e-10  # messages that change less have settled
MOST_ROUNDS = 1000
NONE = -1


@varying(2)
class Weights(NamedTuple):
    """What maps are made of.

    Attributes:
        detected: (tracks, detections), the weight of a pair; 0 outside a gate.
        missed: (tracks,), positive.
    """

    detected: Floats
    missed: Floats


@varying(2)
class AssociationMemory(NamedTuple):
    """What association works in, for so many tracks and detections at most.

    Attributes:
        rows, columns: the tracks and detections of a cluster.
        is_seen: whether a detection is in a cluster already.
        pair, alone, spare: weights of items with slots, of items without one, and of slots without one.
        forward, backward: sums over the maps of the first items, and of the others, by the set of slots
            that are taken.
        message: from detections to tracks.
        price, row_of, distance, before, is_done: of the columns of an assignment; `potential` and
            `column_of` of its rows.
    """

    rows: Integers
    columns: Integers
    is_seen: Booleans
    pair: Floats
    alone: Floats
    spare: Floats
    forward: Floats
    backward: Floats
    message: Floats
    price: Floats
    row_of: Integers
    distance: Floats
    before: Integers
    is_done: Booleans
    potential: Floats
    column_of: Integers


def memory_for(tracks: int, detections: int) -> AssociationMemory:
    """Memory for scans of so many tracks and detections at most."""
    items, columns = max(tracks, detections), tracks + detections
    slots = min(tracks, detections, MOST_ENUMERATED)
    return AssociationMemory(
        rows=np.empty(tracks, np.int64),
        columns=np.empty(detections, np.int64),
        is_seen=np.empty(detections, bool),
        pair=np.empty((items, slots)),
        alone=np.empty(items),
        spare=np.empty(slots),
        forward=np.empty((items + 1, 1 << slots)),
        backward=np.empty(1 << slots),
        message=np.empty((tracks, detections)),
        price=np.empty(columns),
        row_of=np.empty(columns, np.int64),
        distance=np.empty(columns),
        before=np.empty(columns, np.int64),
        is_done=np.empty(columns, bool),
        potential=np.empty(tracks),
        column_of=np.empty(tracks, np.int64),
    )


def jpda(
    weights: Weights, tracks: int, detections: int, probability: Floats, memory: AssociationMemory
) -> int:
    """Fill the marginals (tracks, 1 + detections) of all maps; the first column is for no detection.

    Tracks that share no detection, not even through others, are independent: each cluster is summed on
    its own, exactly where it has at most MOST_ENUMERATED tracks or as many detections. Returns how many
    tracks are in larger ones, whose marginals are those of belief propagation.
    """
    approximated = 0
    for column in range(detections):
        memory.is_seen[column] = False
    for row in range(tracks):
        probability[row, 0] = NONE  # not in a cluster yet
        for column in range(detections):
            probability[row, 1 + column] = 0.0
    for row in range(tracks):
        if probability[row, 0] >= 0.0:
            continue
        rows, columns = gather_cluster(row, weights, tracks, detections, probability, memory)
        if min(rows, columns) <= MOST_ENUMERATED:
            enumerate_maps(weights, rows, columns, probability, memory)
        else:
            propagate_beliefs(weights, rows, columns, probability, memory)
            approximated += rows
    return approximated


def gather_cluster(
    first: int,
    weights: Weights,
    tracks: int,
    detections: int,
    probability: Floats,
    memory: AssociationMemory,
) -> tuple[int, int]:
    """List the tracks and detections that are connected with a track; returns how many there are."""
    memory.rows[0], probability[first, 0] = first, 0.0
    rows, columns, next_row = 1, 0, 0
    while next_row < rows:
        row = memory.rows[next_row]
        next_row += 1
        for column in range(detections):
            if weights.detected[row, column] == 0.0 or memory.is_seen[column]:
                continue
            memory.is_seen[column] = True
            memory.columns[columns] = column
            columns += 1
            for other in range(tracks):
                if probability[other, 0] < 0.0 and weights.detected[other, column] > 0.0:
                    probability[other, 0] = 0.0
                    memory.rows[rows] = other
                    rows += 1
    return rows, columns


def enumerate_maps(
    weights: Weights, rows: int, columns: int, probability: Floats, memory: AssociationMemory
) -> None:
    """The marginals of one cluster by the sum over all of its maps.

    Of tracks and detections the fewer are slots, which the others, the items, take one after another.
    What the later items can do depends on the set of slots that are taken, not on who took them: sums
    over maps are sums over these 2^slots sets.
    """
    tracks_are_slots = rows <= columns
    slots, items = (rows, columns) if tracks_are_slots else (columns, rows)
    total = sum_maps(weights, rows, columns, memory)
    for slot in range(slots):
        if tracks_are_slots:
            probability[memory.rows[slot], 0] = ending_without(slot, items, slots, memory) / total
    for item in range(items - 1, -1, -1):
        if not tracks_are_slots:
            left = 0.0
            for taken in range(1 << slots):
                left += memory.forward[item, taken] * memory.backward[taken]
            probability[memory.rows[item], 0] = left * memory.alone[item] / total
        for slot in range(slots):
            if memory.pair[item, slot] == 0.0:
                continue
            paired = 0.0
            for taken in range(1 << slots):
                if not taken >> slot & 1:
                    paired += memory.forward[item, taken] * memory.backward[taken | 1 << slot]
            k, j = (slot, item) if tracks_are_slots else (item, slot)
            row, column = memory.rows[k], memory.columns[j]
            probability[row, 1 + column] = paired * memory.pair[item, slot] / total
        for taken in range(1 << slots):  # sets with more slots, which come later, are still unchanged
            entry = memory.alone[item] * memory.backward[taken]
            for slot in range(slots):
                if not taken >> slot & 1:
                    entry += memory.pair[item, slot] * memory.backward[taken | 1 << slot]
            memory.backward[taken] = entry


def sum_maps(weights: Weights, rows: int, columns: int, memory: AssociationMemory) -> float:
    """Fill a cluster's sums `forward`, and `backward` behind the last item; returns that of all maps."""
    tracks_are_slots = rows <= columns
    slots, items = (rows, columns) if tracks_are_slots else (columns, rows)
    for each in range(items):
        memory.alone[each] = 1.0
    for each in range(slots):
        memory.spare[each] = 1.0
    for k in range(rows):
        row = memory.rows[k]
        largest = weights.missed[row]  # what all weights of a track have in common cancels out
        for j in range(columns):
            largest = max(largest, weights.detected[row, memory.columns[j]])
        for j in range(columns):
            item, slot = (j, k) if tracks_are_slots else (k, j)
            memory.pair[item, slot] = weights.detected[row, memory.columns[j]] / largest
        without = memory.spare if tracks_are_slots else memory.alone
        without[k] = weights.missed[row] / largest
    total = 0.0
    for taken in range(1 << slots):
        memory.forward[0, taken] = 1.0 if taken == 0 else 0.0
    for item in range(items):
        for taken in range(1 << slots):
            entry = memory.alone[item] * memory.forward[item, taken]
            for slot in range(slots):
                if taken >> slot & 1:
                    entry += memory.pair[item, slot] * memory.forward[item, taken ^ 1 << slot]
            memory.forward[item + 1, taken] = entry
    for taken in range(1 << slots):
        memory.backward[taken] = 1.0
        for slot in range(slots):
            if not taken >> slot & 1:
                memory.backward[taken] *= memory.spare[slot]
        total += memory.forward[items, taken] * memory.backward[taken]
    return total


def ending_without(slot: int, items: int, slots: int, memory: AssociationMemory) -> float:
    """The sum over the maps in which no item takes a slot."""
    found = 0.0
    for taken in range(1 << slots):
        if not taken >> slot & 1:
            found += memory.forward[items, taken] * memory.backward[taken]
    return found


def propagate_beliefs(
    weights: Weights, rows: int, columns: int, probability: Floats, memory: AssociationMemory
) -> None:
    """About the marginals of one cluster: messages between tracks and detections until they settle.

    They are exact where the cluster is a tree, and more certain than exact ones else.
    """
    for k in range(rows):
        for j in range(columns):
            memory.message[memory.rows[k], memory.columns[j]] = 1.0
    for _ in range(MOST_ROUNDS):
        largest_change = 0.0
        for k in range(rows):
            row = memory.rows[k]
            total = weights.missed[row]
            for j in range(columns):
                column = memory.columns[j]
                total += weights.detected[row, column] * memory.message[row, column]
            for j in range(columns):
                column = memory.columns[j]
                weight = weights.detected[row, column]
                # kept where the marginals will be: what a track tells a detection
                rest = total - weight * memory.message[row, column]
                probability[row, 1 + column] = weight / rest
        for j in range(columns):
            column = memory.columns[j]
            total = 1.0
            for k in range(rows):
                total += probability[memory.rows[k], 1 + column]
            for k in range(rows):
                row = memory.rows[k]
                message = 1.0 / (total - probability[row, 1 + column])
                largest_change = max(largest_change, abs(message - memory.message[row, column]))
                memory.message[row, column] = message
        if largest_change < PROPAGATED:
            break
    for k in range(rows):
        row = memory.rows[k]
        total = weights.missed[row]
        for j in range(columns):
            column = memory.columns[j]
            total += weights.detected[row, column] * memory.message[row, column]
        probability[row, 0] = weights.missed[row] / total
        for j in range(columns):
            column = memory.columns[j]
            weight = weights.detected[row, column]
            probability[row, 1 + column] = weight * memory.message[row, column] / total


def choose(row: int, column: int, detections: int, probability: Floats) -> None:
    """Fill a track's row where its detection is chosen; NONE for none."""
    for entry in range(1 + detections):
        probability[row, entry] = 1.0 if entry == 1 + column else 0.0


def nearest(
    weights: Weights, tracks: int, detections: int, probability: Floats, memory: AssociationMemory
) -> int:
    """Choose one map: the surest pair first, then the surest of the tracks and detections left."""
    for column in range(detections):
        memory.is_seen[column] = False
    for row in range(tracks):
        memory.column_of[row] = NONE
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
    """Choose the map of the greatest weight: successive shortest augmenting paths (Crouse, fig. 3).

    Column j of the assignment is detection j, and column detections + i stands for track i's miss.
    """
    columns = detections + tracks
    for column in range(columns):
        memory.price[column], memory.row_of[column] = 0.0, NONE
    for row in range(tracks):
        memory.potential[row], memory.column_of[row] = 0.0, NONE
    for first in range(tracks):
        for column in range(columns):
            memory.distance[column], memory.is_done[column] = np.inf, False
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
    """What a pair costs beside a miss: minus the log of its weight; infinity where it cannot be."""
    if column >= detections:
        return 0.0 if column - detections == row else np.inf
    return -np.log(weights.detected[row, column] / weights.missed[row])


ASSOCIATIONS = {"nearest": nearest, "hungarian": hungarian, "jpda": jpda}


def existence_after(existence: float, none: float, detection_probability: float) -> float:
    """How probable it is that a track exists, after a scan that gave it no detection by `none`.

    Musicki and Evans' (15): a miss tells against it by as much as its detection was probable.
    """
    missed = 1.0 - detection_probability
    if_missed = missed * existence / (1.0 - detection_probability * existence)
    return 1.0 - none + none * if_missed


def marginals(detected: ArrayLike, missed: ArrayLike, association: str = "jpda") -> Floats:
    """How probable it is that each track has no detection, the first, the second ...: (tracks, 1 + n).

    Args:
        detected: (tracks, n), the weights of pairs; 0 outside a gate.
        missed: (tracks,), those of misses.
        association: one of ASSOCIATIONS; "nearest" and "hungarian" choose one map.

    Raises BadInput where the weights are none, or there is no such association.

    Two tracks between which a detection lies:

    >>> marginals([[3.0], [1.0]], [1.0, 1.0])
    array([[0.4, 0.6],
           [0.8, 0.2]])
    """
    weights = Weights(np.array(detected, float, ndmin=2), np.array(missed, float))
    tracks, detections = weights.detected.shape
    finite = np.isfinite(weights.detected).all() and np.isfinite(weights.missed).all()
    if weights.missed.shape != (tracks,) or not finite or (weights.detected < 0.0).any():
        raise BadInput(
            "weights: give finite ones of shapes (tracks, detections) for pairs and (tracks,) for misses"
        )
    if (weights.missed <= 0.0).any():
        raise BadInput(
            "weights: those of misses must be positive, since no track is detected for certain"
        )
    if association not in ASSOCIATIONS:
        raise BadInput(f"no association '{association}'; {choices(association, ASSOCIATIONS)}")
    probability = np.empty((tracks, 1 + detections))
    memory = memory_for(tracks, detections)
    _compiled(association)(weights, tracks, detections, probability, memory)
    return probability


@cache
def _compiled(association: str) -> Function:
    return compiled(ASSOCIATIONS[association], allocates=False)
