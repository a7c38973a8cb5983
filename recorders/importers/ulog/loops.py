"""Loops over a ULog's data: where messages begin, which are whose; see `fuselog.recorders.log.loops`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log.loops import loop_for, words_of

HEAD_BYTES = 3
# So many rows after one another, whose lengths are those of their topics, are no chance.
CHAIN = 3
# Beyond the bytes that are walked there have to be so many more, of any value.
BEYOND_BYTES = 16
NUMBERS = 1 << 16


class Walk(NamedTuple):
    """States where the messages of a piece of a file begin, in bytes.

    `data` are those with a topic's numbers, `others` all others. `end` is where the walk stopped, at a
    message that is not whole, or that can be none if `is_broken`.
    """

    data: NDArray[np.int64]
    others: NDArray[np.int64]
    end: int
    is_broken: bool


class Known(NamedTuple):
    """Holds what is known of each number's topic (NUMBERS,); `since` of a number without one is never.

    A row has `least` to `most` bytes, begins from the byte `since` on and before the byte `until` of the
    file, and has its stamp at the byte `stamp`.
    """

    least: NDArray[np.int64]
    most: NDArray[np.int64]
    stamp: NDArray[np.int64]
    since: NDArray[np.int64]
    until: NDArray[np.int64]


class Sorted(NamedTuple):
    """Holds rows (n,) of a piece, by their number.

    `order` has the rows number by number, each in the file's order, and `counts` (NUMBERS + 1,) how many
    each has; those that are no topic's come last. `stamps` are in us, 0 of what is no topic's;
    `is_timed` says which are between two times, and `reached` is the latest of these before every row,
    and at the end. Rows stop before one of a length that is not its format's.
    """

    order: NDArray[np.int64]
    counts: NDArray[np.int64]
    stamps: NDArray[np.int64]
    is_timed: NDArray[np.bool_]
    reached: NDArray[np.int64]


def walk(data: NDArray[np.uint8], size: int) -> Walk:
    """Find where the messages of a piece of a file begin.

    Args:
        data: the piece, and at least `BEYOND_BYTES` more.
        size: how many bytes the piece has.
    """
    found, others, end, is_broken = loop_for(_walk, size)(words_of(data), size)
    return Walk(found, others, int(end), bool(is_broken))


def resume(data: NDArray[np.uint8], begin: int, size: int, place: int, known: Known) -> int:
    """Find where rows begin again after bytes that are no messages: several, of lengths that fit.

    Args:
        data: a piece of the file, and at least `BEYOND_BYTES` more.
        begin: from which byte of the piece on.
        size: how many bytes the piece has.
        place: where the piece begins in the file.
        known: what rows there are.

    Returns:
        The byte of the piece; -1 where there is none.
    """
    return int(loop_for(_resume, size)(words_of(data), begin, size, place, known))


def sort(
    data: NDArray[np.uint8],
    at: NDArray[np.int64],
    place: int,
    known: Known,
    times: tuple[int, int, int],
) -> Sorted:
    """Sort the rows of a piece of a file by their topic's number.

    Args:
        data: the piece, and at least `BEYOND_BYTES` more.
        at: (n,), where the rows begin, in bytes of the piece, as `Walk.data`.
        place: where the piece begins in the file.
        known: what rows there are.
        times: in us: a stamp lies between the first two, and not at them; the third is the latest so
            far.
    """
    words = words_of(data)
    return Sorted(*loop_for(_sort, 64 * len(at))(words, words.view("<i8"), at, place, known, times))


def _sort(words, numbers, at, place, known, times):  # type: ignore[no-untyped-def]
    least, most, stamp_at, since, until = known
    low, high, latest = times
    size = len(at)
    whose = np.empty(size, np.int64)
    stamps = np.zeros(size, np.int64)
    is_timed = np.zeros(size, np.bool_)
    reached = np.empty(size + 1, np.int64)
    counts = np.zeros(NUMBERS + 1, np.int64)
    for row in range(size):
        position = at[row]
        head = words[position]
        number = np.int64(head >> np.uint64(24) & np.uint64(0xFFFF))
        length = np.int64(head & np.uint64(0xFFFF)) - 2
        if length < least[number] or length > most[number]:
            size = row
            break
        reached[row] = latest
        if since[number] <= place + position < until[number]:
            stamp = numbers[position + 5 + stamp_at[number]]
            stamps[row] = stamp
            if stamp != 0 and low < stamp < high:
                is_timed[row] = True
                latest = max(latest, stamp)
        else:
            number = np.int64(NUMBERS)
        whose[row] = number
        counts[number] += 1
    reached[size] = latest
    order = np.empty(size, np.int64)
    places = np.cumsum(counts) - counts
    for row in range(size):
        order[places[whose[row]]] = row
        places[whose[row]] += 1
    return order, counts, stamps[:size], is_timed[:size], reached[: size + 1]


def _walk(words, size):  # type: ignore[no-untyped-def] # numba infers the types
    data = np.empty(size // 5 + 1, np.int64)
    others = np.empty(size // 3 + 1, np.int64)
    count, other, position = 0, 0, np.int64(0)
    is_broken = False
    while position + 3 <= size:
        word = words[position]
        length = np.int64(word & np.uint64(0xFFFF))
        kind = np.int64(word >> np.uint64(16) & np.uint64(0xFF))
        if length == 0 or kind < 65 or kind > 90:
            is_broken = True
            break
        end = position + 3 + length
        if end > size:
            break
        if kind == 68:
            if length < 2:
                is_broken = True
                break
            data[count] = position
            count += 1
        else:
            others[other] = position
            other += 1
        position = end
    return data[:count].copy(), others[:other].copy(), position, is_broken


def _resume(words, begin, size, place, known):  # type: ignore[no-untyped-def]
    least, most, _, since, until = known
    for first in range(begin, size - 5):
        position, count = np.int64(first), 0
        while count < CHAIN and position + 5 <= size:
            head = words[position]
            number = np.int64(head >> np.uint64(24) & np.uint64(0xFFFF))
            length = np.int64(head & np.uint64(0xFFFF)) - 2
            if np.int64(head >> np.uint64(16) & np.uint64(0xFF)) != 68:
                break
            if not since[number] <= place + position < until[number]:
                break
            if length < least[number] or length > most[number]:
                break
            position += length + 5
            count += 1
        if count == CHAIN:
            return first
    return -1
