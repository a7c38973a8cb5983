"""Loops over a ULog's data: where messages begin, which are whose; see `fuselog.recorders.log.loops`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log.loops import kernel, word

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
    found, others, sizes = (np.empty(count, np.int64) for count in (size // 5 + 1, size // 3 + 1, 3))
    is_broken = kernel(_walk)(data, size, found, others, sizes)
    count, other, end = sizes.tolist()
    return Walk(found[:count].copy(), others[:other].copy(), end, is_broken)


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
    return kernel(_resume)(data, begin, size, place, known)


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
    whose, stamps = np.empty((2, len(at)), np.int64)
    is_timed = np.empty(len(at), np.bool_)
    reached, counts = np.empty(len(at) + 1, np.int64), np.zeros(NUMBERS + 1, np.int64)
    size = kernel(_examine)(data, at, place, known, times, whose, stamps, is_timed, reached, counts)
    order, places = np.empty(size, np.int64), np.cumsum(counts) - counts
    kernel(_sort)(whose[:size], places, order)
    return Sorted(order, counts, stamps[:size], is_timed[:size], reached[: size + 1])


def _length(data: NDArray[np.uint8], position: int) -> int:
    """Return how many bytes follow the head of the message at a place."""
    return word(data, position) & 0xFFFF


def _kind(data: NDArray[np.uint8], position: int) -> int:
    """Return which kind of message is at a place: a letter."""
    return word(data, position) >> 16 & 0xFF


def _number(data: NDArray[np.uint8], position: int) -> int:
    """Return the number that a row at a place has its topic by."""
    return word(data, position) >> 24 & 0xFFFF


def _examine(
    data: NDArray[np.uint8],
    at: NDArray[np.int64],
    place: int,
    known: Known,
    times: tuple[int, int, int],
    whose: NDArray[np.int64],
    stamps: NDArray[np.int64],
    is_timed: NDArray[np.bool_],
    reached: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> int:
    """Fill whose the rows are, and their stamps, up to the first of a wrong length; count them."""
    low, high, latest = times
    for row in range(len(at)):
        position = at[row]
        reached[row] = latest
        number, length = _number(data, position), _length(data, position) - 2
        if length < known.least[number] or length > known.most[number]:
            return row
        stamps[row], is_timed[row] = 0, False
        if known.since[number] <= place + position < known.until[number]:
            stamps[row] = word(data, position + 5 + known.stamp[number])
            if stamps[row] != 0 and low < stamps[row] < high:
                is_timed[row] = True
                latest = max(latest, stamps[row])
        else:
            number = NUMBERS
        whose[row] = number
        counts[number] += 1
    reached[len(at)] = latest
    return len(at)


def _sort(whose: NDArray[np.int64], places: NDArray[np.int64], order: NDArray[np.int64]) -> None:
    """Fill which rows come after one another, number by number; `places` has where each begins."""
    for row in range(len(whose)):
        order[places[whose[row]]] = row
        places[whose[row]] += 1


def _walk(
    data: NDArray[np.uint8],
    size: int,
    found: NDArray[np.int64],
    others: NDArray[np.int64],
    sizes: NDArray[np.int64],
) -> bool:
    """Fill where messages begin, their counts and where they end; tell whether the next can be none."""
    count, other, position, is_broken = 0, 0, 0, False
    while position + 3 <= size:
        length, kind = _length(data, position), _kind(data, position)
        if length == 0 or kind < 65 or kind > 90:
            is_broken = True
            break
        if position + 3 + length > size:
            break
        if kind == 68:
            if length < 2:
                is_broken = True
                break
            found[count] = position
            count += 1
        else:
            others[other] = position
            other += 1
        position += 3 + length
    sizes[0], sizes[1], sizes[2] = count, other, position
    return is_broken


def _resume(data: NDArray[np.uint8], begin: int, size: int, place: int, known: Known) -> int:
    """Find the first byte from which several rows of known lengths follow one another."""
    for first in range(begin, size - 5):
        position, count = first, 0
        while count < CHAIN and position + 5 <= size:
            number, length = _number(data, position), _length(data, position) - 2
            if _kind(data, position) != 68:
                break
            if not known.since[number] <= place + position < known.until[number]:
                break
            if length < known.least[number] or length > known.most[number]:
                break
            position += length + 5
            count += 1
        if count == CHAIN:
            return first
    return -1
