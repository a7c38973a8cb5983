"""Sums over the joint associations of clusters of tracks, by enumeration or by message passing."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers, varying

# Belief propagation is used for clusters with more tracks and more detections than this.
MOST_ENUMERATED = 12
PROPAGATED = 1e-10  # messages that change less have converged
MOST_ROUNDS = 1000
NONE = -1


@varying(2)
class Weights(NamedTuple):
    """Weights of pairs of tracks and detections, and of misses.

    Attributes:
        detected: (tracks, detections), the weight of a pair; 0 outside a gate.
        missed: (tracks,), positive.
    """

    detected: Floats
    missed: Floats


@varying(2)
class AssociationMemory(NamedTuple):
    """Scratch memory of an association, for limited numbers of tracks and detections.

    Attributes:
        rows, columns: the tracks and detections of a cluster.
        is_seen: whether a detection is already in a cluster.
        pair, alone, spare: weights of item-slot pairs, of items without a slot, and of slots without an
            item.
        forward, backward: sums over the assignments of the items so far, and over those of the remaining
            items, for each set of occupied slots.
        message: messages from detections to tracks.
        price, row_of, distance, before, is_done: quantities of the columns of an assignment problem;
            those of the rows are `potential` and `column_of`.
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
    """Make memory for scans with up to the given numbers of tracks and detections."""
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
    """Fill the marginals (tracks, 1 + detections) over all joint associations; column 0 is a miss.

    Tracks are independent if they share no detection, either directly or through other tracks. Each
    cluster of connected tracks is summed separately: exactly if the number of its tracks or the number
    of its detections is at most MOST_ENUMERATED, and by belief propagation otherwise. Returns the number
    of tracks in clusters with approximated marginals.

    Args:
        weights: weights of pairs and of misses.
        tracks: number of tracks; the arrays may be longer.
        detections: number of detections; the arrays may be longer.
        probability: (tracks, 1 + detections), filled.
        memory: scratch memory.
    """
    approximated = 0
    memory.is_seen[:detections] = False
    for row in range(tracks):
        probability[row, 0] = NONE  # not in a cluster yet
        probability[row, 1 : 1 + detections] = 0.0
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
    """List the tracks and detections that are connected with a track; return both numbers.

    Args:
        first: index of the track.
        weights: weights of pairs and of misses.
        tracks, detections: numbers of tracks and detections; the arrays may be longer.
        probability: (tracks, 1 + detections); its first column is NONE for tracks that are not yet in a
            cluster.
        memory: memory whose `rows` and `columns` are filled.
    """
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
    """Compute the marginals of one cluster by summing over all of its assignments.

    The members of the smaller group (tracks or detections) are the slots; those of the other group are
    the items, which occupy slots one after another. The choices of later items depend only on the set
    of occupied slots, so sums over assignments become sums over these 2^slots sets.

    Args:
        weights: weights of pairs and of misses.
        rows, columns: numbers of tracks and detections of the cluster.
        probability: (tracks, 1 + detections), filled for the tracks of the cluster.
        memory: memory with the cluster that `gather_cluster` found.
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
        for taken in range(1 << slots):  # larger sets have larger numbers and are still unchanged
            entry = memory.alone[item] * memory.backward[taken]
            for slot in range(slots):
                if not taken >> slot & 1:
                    entry += memory.pair[item, slot] * memory.backward[taken | 1 << slot]
            memory.backward[taken] = entry


def sum_maps(weights: Weights, rows: int, columns: int, memory: AssociationMemory) -> float:
    """Fill the sums `forward` of a cluster, and `backward` after its last item; return the total."""
    tracks_are_slots = rows <= columns
    slots, items = (rows, columns) if tracks_are_slots else (columns, rows)
    memory.alone[:items] = 1.0
    memory.spare[:slots] = 1.0
    for k in range(rows):
        row = memory.rows[k]
        largest = weights.missed[row]  # a common factor of all weights of a track cancels out
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
    """Compute the sum over the assignments in which the given slot is not occupied."""
    found = 0.0
    for taken in range(1 << slots):
        if not taken >> slot & 1:
            found += memory.forward[items, taken] * memory.backward[taken]
    return found


def propagate_beliefs(
    weights: Weights, rows: int, columns: int, probability: Floats, memory: AssociationMemory
) -> None:
    """Approximate the marginals of one cluster by belief propagation between tracks and detections.

    The marginals are exact if the cluster is a tree; otherwise, they are closer to 0 or 1 than the exact
    ones.

    Args:
        weights, rows, columns, probability, memory: as for `enumerate_maps`.
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
                # messages from tracks to detections, stored in the array of the marginals
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
    """Fill the row of a track with 1 for the chosen detection and 0 otherwise.

    Args:
        row: index of the track.
        column: index of the detection; NONE for no detection.
        detections: number of detections.
        probability: (tracks, 1 + detections); the row is filled.
    """
    for entry in range(1 + detections):
        probability[row, entry] = 1.0 if entry == 1 + column else 0.0
