"""Sums over the joint associations of a cluster of tracks: by enumeration, or by message passing."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Booleans, Floats, Integers, varying

# Clusters in which both tracks and detections are more than this are left to belief propagation.
MOST_ENUMERATED = 12
PROPAGATED = 1e-10  # messages that change less have settled
MOST_ROUNDS = 1000
NONE = -1


@varying(2)
class Weights(NamedTuple):
    """Holds what maps are made of.

    Attributes:
        detected: (tracks, detections), the weight of a pair; 0 outside a gate.
        missed: (tracks,), positive.
    """

    detected: Floats
    missed: Floats


@varying(2)
class AssociationMemory(NamedTuple):
    """Holds what association works in, for so many tracks and detections at most.

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
    """Make memory for scans of so many tracks and detections at most."""
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

    Args:
        weights: of pairs and of misses.
        tracks: how many there are; arrays may be longer.
        detections: likewise.
        probability: (tracks, 1 + detections) filled.
        memory: what is worked in.
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
    """List the tracks and detections that are connected with a track; returns how many there are.

    Args:
        first: the track.
        weights: of pairs and of misses.
        tracks, detections: how many there are; arrays may be longer.
        probability: (tracks, 1 + detections), whose first column is NONE for tracks in no cluster yet.
        memory: whose `rows` and `columns` are filled.
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
    """Compute the marginals of one cluster by the sum over all of its maps.

    Of tracks and detections the fewer are slots, which the others, the items, take one after another.
    What the later items can do depends on the set of slots that are taken, not on who took them: sums
    over maps are sums over these 2^slots sets.

    Args:
        weights: of pairs and of misses.
        rows, columns: how many tracks and detections the cluster has.
        probability: (tracks, 1 + detections), filled for these.
        memory: with the cluster that `gather_cluster` found.
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
    memory.alone[:items] = 1.0
    memory.spare[:slots] = 1.0
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
    """Compute the sum over the maps in which no item takes a slot."""
    found = 0.0
    for taken in range(1 << slots):
        if not taken >> slot & 1:
            found += memory.forward[items, taken] * memory.backward[taken]
    return found


def propagate_beliefs(
    weights: Weights, rows: int, columns: int, probability: Floats, memory: AssociationMemory
) -> None:
    """Approximate the marginals of one cluster by messages between tracks and detections that settle.

    They are exact where the cluster is a tree, and more certain than exact ones else.

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
    """Fill a track's row where its detection is chosen; NONE for none.

    Args:
        row: the track's.
        column: of the detection; NONE for none.
        detections: how many there are.
        probability: (tracks, 1 + detections), of which the row is filled with 0 and 1.
    """
    for entry in range(1 + detections):
        probability[row, entry] = 1.0 if entry == 1 + column else 0.0
