"""The loop over the bytes of a ULog's data: where its messages begin; see `recorders.log.loops`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorders.log.loops import loop_for, words_of

HEAD_BYTES = 3
# Beyond the bytes that are walked there have to be so many more, of any value.
BEYOND_BYTES = 16


class Walk(NamedTuple):
    """Where the messages of a piece of a file begin, in bytes.

    `data` are those with a topic's numbers, `others` all others. `end` is where the walk stopped, at a
    message that is not whole, or that can be none if `is_broken`.
    """

    data: NDArray[np.int64]
    others: NDArray[np.int64]
    end: int
    is_broken: bool


def walk(data: NDArray[np.uint8], size: int) -> Walk:
    """Walk the first `size` bytes of `data`, which has BEYOND_BYTES more."""
    found, others, end, is_broken = loop_for(_walk, size)(words_of(data), size)
    return Walk(found, others, int(end), bool(is_broken))


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
