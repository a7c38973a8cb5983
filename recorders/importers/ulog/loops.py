"""Loops over a ULog's data that find and assign messages; see `fuselog.recorders.log.loops`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log.loops import kernel, word

HEAD_BYTES = 3
# This many successive rows with the lengths of their topics are not a coincidence.
CHAIN = 3
# How many bytes, of any value, must follow the bytes that are walked.
BEYOND_BYTES = 16
NUMBERS = 1 << 16


class Walk(NamedTuple):
    """The positions of the messages in a piece of a file, in bytes.

    `data` are messages with a topic's rows, `others` all other messages. `end` is the position at
    which the walk stopped: at an incomplete message, or at an invalid one if `is_broken`.
    """

    data: NDArray[np.int64]
    others: NDArray[np.int64]
    end: int
    is_broken: bool


class Known(NamedTuple):
    """The topic of each message number (NUMBERS,); `since` is "never" for a number without a topic.

    A row has `least` to `most` bytes, begins in the file at byte `since` or later and before byte
    `until`, and has its stamp at byte `stamp`.
    """

    least: NDArray[np.int64]
    most: NDArray[np.int64]
    stamp: NDArray[np.int64]
    since: NDArray[np.int64]
    until: NDArray[np.int64]


class Sorted(NamedTuple):
    """The rows (n,) of a piece, sorted by message number.

    `order` has the rows grouped by message number, each group in file order, and `counts` (NUMBERS + 1,)
    has the sizes of the groups; rows without a topic are the last group. `stamps` are in us, 0 for rows
    without a topic; `is_timed` marks valid stamps, and `reached` is the latest valid stamp before each
    row, and at the end. The rows end before the first row whose length does not match its format.
    """

    order: NDArray[np.int64]
    counts: NDArray[np.int64]
    stamps: NDArray[np.int64]
    is_timed: NDArray[np.bool_]
    reached: NDArray[np.int64]


def walk(data: NDArray[np.uint8], size: int) -> Walk:
    """Find where the messages of a piece of a file begin.

    Args:
        data: the piece, followed by at least `BEYOND_BYTES` more bytes.
        size: length of the piece in bytes.
    """
    found, others, sizes = (np.empty(count, np.int64) for count in (size // 5 + 1, size // 3 + 1, 3))
    is_broken = kernel(_walk)(data, size, found, others, sizes)
    count, other, end = sizes.tolist()
    return Walk(found[:count].copy(), others[:other].copy(), end, is_broken)


def resume(data: NDArray[np.uint8], begin: int, size: int, place: int, known: Known) -> int:
    """Find where rows resume after invalid bytes: at several rows in sequence with matching lengths.

    Args:
        data: a piece of the file, followed by at least `BEYOND_BYTES` more bytes.
        begin: first byte of the piece to try.
        size: length of the piece in bytes.
        place: position of the piece in the file.
        known: the known topics.

    Returns:
        The position in the piece; -1 if there is none.
    """
    return kernel(_resume)(data, begin, size, place, known)


def sort(
    data: NDArray[np.uint8],
    at: NDArray[np.int64],
    place: int,
    known: Known,
    times: tuple[int, int, int],
) -> Sorted:
    """Sort the rows of a piece of a file by the message numbers of their topics.

    Args:
        data: the piece, followed by at least `BEYOND_BYTES` more bytes.
        at: (n,), positions of the rows in the piece, as in `Walk.data`.
        place: position of the piece in the file.
        known: the known topics.
        times: three times (us): valid stamps are strictly between the first two; the third is the latest
            stamp so far.
    """
    whose, stamps = np.empty((2, len(at)), np.int64)
    is_timed = np.empty(len(at), np.bool_)
    reached, counts = np.empty(len(at) + 1, np.int64), np.zeros(NUMBERS + 1, np.int64)
    size = kernel(_examine)(data, at, place, known, times, whose, stamps, is_timed, reached, counts)
    order, places = np.empty(size, np.int64), np.cumsum(counts) - counts
    kernel(_sort)(whose[:size], places, order)
    return Sorted(order, counts, stamps[:size], is_timed[:size], reached[: size + 1])


def _length(data: NDArray[np.uint8], position: int) -> int:
    """Return the number of bytes after the head of the message at a position."""
    return word(data, position) & 0xFFFF


def _kind(data: NDArray[np.uint8], position: int) -> int:
    """Return the kind of the message at a position: a letter."""
    return word(data, position) >> 16 & 0xFF


def _number(data: NDArray[np.uint8], position: int) -> int:
    """Return the number of the topic of the row at a position."""
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
    """Fill in the topics and stamps of rows up to the first with a wrong length; count these rows."""
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
    """Fill in the rows by message number; `places` is where the rows of each number begin in `order`."""
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
    """Fill in the positions, counts and end of messages; test whether the next message is invalid."""
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
