"""Loops over the bytes of a chunk: finds its records, and compares messages with a layout.

The loops see the bytes as 64-bit words, one of which starts at every byte, so that they compare eight
bytes at a time. numba compiles them, and takes longer to import than plain Python to go through twenty
megabytes: the first sixteen are gone through so, in a process that has no other use for numba.
Source: the MCAP specification (mcap.dev/spec), records Message, Schema and Channel.
"""

import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

# Opcode and length of a record; then channel, sequence and two clocks of a message.
HEAD_BYTES = 9
MESSAGE_HEAD_BYTES = HEAD_BYTES + 22

# Bytes that are gone through without numba.
_left = Counter(plain=16 << 20)

_MESSAGE = int(Opcode.MESSAGE)
_SCHEMA = int(Opcode.SCHEMA)
_CHANNEL = int(Opcode.CHANNEL)


class Scan(NamedTuple):
    """Holds what a walk over a chunk's records finds; offsets in bytes, times in ns.

    `messages` are channel by channel, each in file order, and `counts` says how many each channel has.
    `end` is where the walk stopped: the chunk's length, or the first record that is not whole.
    """

    messages: NDArray[np.int64]
    counts: NDArray[np.int64]
    declarations: NDArray[np.int64]
    log_time_ns: tuple[int, int]
    publish_time_ns: tuple[int, int]
    end: int


class Pattern(NamedTuple):
    """Holds the bytes that all records of a layout share: words at `places` within its `size` bytes."""

    size: int
    places: NDArray[np.int64]
    expected: NDArray[np.uint64]
    mask: NDArray[np.uint64]


def pattern_of(record: NDArray[np.uint8], is_fixed: NDArray[np.uint8]) -> Pattern:
    """Return the pattern of the bytes that all records of a layout share.

    Args:
        record: (size,), the bytes of one.
        is_fixed: (size,), 0xFF where they are the same in all.
    """
    size = len(record)
    places = np.unique(np.minimum(np.arange(0, size, 8), size - 8))
    mask = words_of(is_fixed)[places]
    places, mask = places[mask != 0], mask[mask != 0]
    return Pattern(size, places, words_of(record)[places] & mask, mask)


def scan(data: NDArray[np.uint8]) -> Scan:
    """Walk the records of a chunk."""
    return Scan(*loop_for(_scan, len(data))(words_of(data), len(data)))


def agree(data: NDArray[np.uint8], offsets: NDArray[np.int64], pattern: Pattern) -> bool:
    """Tell whether records lie inside a chunk and have the pattern's bytes.

    Args:
        data: the chunk.
        offsets: (n,), where the records begin, ascending; at least one.
        pattern: theirs.
    """
    if offsets[-1] + pattern.size > len(data):
        return False
    agreed = loop_for(_agree, len(offsets) * pattern.size)
    return bool(agreed(words_of(data), offsets, pattern.places, pattern.expected, pattern.mask))


def words_of(data: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return the words that start at every byte of `data` but the last seven, without a copy."""
    count = max(len(data) - 7, 0)
    return np.ndarray((count,), "<u8", data.data if count else None, strides=(1,))


def loop_for(loop: Callable[..., Any], size: int) -> Callable[..., Any]:
    """Return the loop to go through so many bytes with."""
    _left["plain"] -= size
    if _left["plain"] >= 0 and "numba" not in sys.modules:
        return np.errstate(over="ignore")(loop)
    return _compiled(loop)


@cache
def _compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    from numba import njit

    # The code is kept beside this file, under its time and size, and names this module: if the module
    # moves, the file has to change, or what was kept fails to load.
    return njit(cache=True, nogil=True)(loop)


def _scan(words, size):  # type: ignore[no-untyped-def] # numba infers the types
    found = np.empty(size // MESSAGE_HEAD_BYTES, np.int64)
    channel_ids = np.empty(len(found), np.uint16)
    declarations = np.empty(size // HEAD_BYTES, np.int64)
    count, declared, position = 0, 0, np.int64(0)
    highest = np.uint64(0xFFFFFFFFFFFFFFFF)
    first_log, last_log, first_publish, last_publish = highest, np.uint64(0), highest, np.uint64(0)
    while position + HEAD_BYTES <= size:
        opcode = words[position] & np.uint64(0xFF)
        end = position + HEAD_BYTES + np.int64(words[position + 1])
        if end > size or end <= position:
            break
        if opcode == _MESSAGE:
            if end - position < MESSAGE_HEAD_BYTES:
                break
            found[count] = position
            channel_ids[count] = words[position + 8] >> np.uint64(8) & np.uint64(0xFFFF)
            count += 1
            log, publish = words[position + 15], words[position + 23]
            first_log, last_log = min(first_log, log), max(last_log, log)
            first_publish, last_publish = min(first_publish, publish), max(last_publish, publish)
        elif opcode in (_SCHEMA, _CHANNEL):
            declarations[declared] = position
            declared += 1
        position = end
    counts = np.zeros(channel_ids[:count].max() + 1 if count else 0, np.int64)
    for channel_id in channel_ids[:count]:
        counts[channel_id] += 1
    messages = np.empty(count, np.int64)
    places = np.cumsum(counts) - counts
    for row in range(count):
        messages[places[channel_ids[row]]] = found[row]
        places[channel_ids[row]] += 1
    return (
        messages,
        counts,
        declarations[:declared].copy(),
        (first_log, last_log),
        (first_publish, last_publish),
        position,
    )


def _agree(words, offsets, places, expected, mask):  # type: ignore[no-untyped-def]
    for offset in offsets:
        wrong = np.uint64(0)
        for k in range(len(places)):
            wrong |= (words[offset + places[k]] ^ expected[k]) & mask[k]
        if wrong:
            return False
    return True
