"""Loops over the bytes of a chunk, which find its records and compare messages with a layout.

The loops are kernels (`fuselog.recorders.compiling`), and are compiled even if filters are not. They
read eight bytes at a time as a word, which LLVM turns into one instruction.
Source: the MCAP specification (mcap.dev/spec), records Message, Schema and Channel.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# Opcode and length of a record; then channel, sequence and two clocks of a message.
HEAD_BYTES = 9
MESSAGE_HEAD_BYTES = HEAD_BYTES + 22

_MESSAGE = int(Opcode.MESSAGE)
_SCHEMA = int(Opcode.SCHEMA)
_CHANNEL = int(Opcode.CHANNEL)


class Scan(NamedTuple):
    """The result of a walk over a chunk's records; offsets in bytes, times in ns.

    `messages` are grouped by channel, each group in file order, and `counts` has the number of each
    channel's messages. `end` is the position at which the walk stopped: the chunk's length, or the first
    incomplete record.
    """

    messages: NDArray[np.int64]
    counts: NDArray[np.int64]
    declarations: NDArray[np.int64]
    log_time_ns: tuple[int, int]
    publish_time_ns: tuple[int, int]
    end: int


class Pattern(NamedTuple):
    """The bytes that all records of a layout share: words at `places` within its `size` bytes."""

    size: int
    places: NDArray[np.int64]
    expected: NDArray[np.int64]
    mask: NDArray[np.int64]


def pattern_of(record: NDArray[np.uint8], is_fixed: NDArray[np.uint8]) -> Pattern:
    """Compute the pattern of the bytes that all records of a layout share.

    Args:
        record: (size,), bytes of one record.
        is_fixed: (size,), 0xFF for bytes that are the same in all records.
    """
    size = len(record)
    places = np.minimum(np.arange(0, size, 8), size - 8)
    eight = places[:, None] + np.arange(8)
    words, mask = (np.ascontiguousarray(each[eight]).view("<i8")[:, 0] for each in (record, is_fixed))
    places, words, mask = places[mask != 0], words[mask != 0], mask[mask != 0]
    return Pattern(size, places, words & mask, mask)


def scan(data: NDArray[np.uint8]) -> Scan:
    """Find the records of a chunk."""
    found = np.empty(len(data) // MESSAGE_HEAD_BYTES, np.int64)
    declarations = np.empty(len(data) // HEAD_BYTES, np.int64)
    highest = np.iinfo(np.uint64).max
    times, sizes = np.array([[highest, 0], [highest, 0]], np.uint64), np.empty(3, np.int64)
    end = kernel(_scan)(data, found, declarations, times, sizes)
    count, declared, channels = sizes.tolist()
    messages, counts, places = (np.zeros(size, np.int64) for size in (count, channels, channels + 1))
    kernel(_sort)(data, found, messages, counts, places)
    log_ns, publish_ns = map(tuple, times.tolist())
    return Scan(messages, counts, declarations[:declared].copy(), log_ns, publish_ns, end)


def agree(data: NDArray[np.uint8], offsets: NDArray[np.int64], pattern: Pattern) -> bool:
    """Test whether records are inside a chunk and match a pattern.

    Args:
        data: the chunk.
        offsets: (n,), positions of the records, ascending; at least one.
        pattern: pattern of the records.
    """
    if offsets[-1] + pattern.size > len(data):
        return False
    return kernel(_agree)(data, offsets, pattern.places, pattern.expected, pattern.mask)


def load() -> None:
    """Compile, or load, the loops that read a log."""
    record = np.zeros(MESSAGE_HEAD_BYTES, np.uint8)
    scan(record)
    agree(record, np.zeros(1, np.int64), pattern_of(record, record))


@cache
def kernel(loop: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a loop, even if FUSELOG_UNCOMPILED disables the compilation of filters."""
    from fuselog.recorders.compiling.kernels.native import function_of

    return function_of(loop)


def word(data: NDArray[np.uint8], place: int) -> int:
    """Read the little-endian number in eight bytes; in a kernel, it is signed.

    Args:
        data: bytes.
        place: position of the number.
    """
    part, number = data[np.uint64(place) :], 0
    for k in (7, 6, 5, 4, 3, 2, 1, 0):
        number = number << 8 | int(part[k])
    return number


def _scan(
    data: NDArray[np.uint8],
    found: NDArray[np.int64],
    declarations: NDArray[np.int64],
    times: NDArray[np.uint64],
    sizes: NDArray[np.int64],
) -> int:
    """Fill in the positions of messages and declarations, and the first and last times of messages.

    `sizes` gets the number of messages, the number of declarations, and the highest channel plus one.
    """
    size, count, declared, channels, position = len(data), 0, 0, 0, 0
    while position + HEAD_BYTES <= size:
        opcode, length = data[position], word(data, position + 1)
        if length < 0 or length > size - position - HEAD_BYTES:
            break
        if opcode == _MESSAGE:
            if length < MESSAGE_HEAD_BYTES - HEAD_BYTES:
                break
            found[count] = position
            channels = max(channels, _channel(data, position) + 1)
            count += 1
            for k in (0, 1):
                time = np.uint64(word(data, position + 15 + 8 * k))
                times[k, 0] = min(times[k, 0], time)
                times[k, 1] = max(times[k, 1], time)
        elif opcode in (_SCHEMA, _CHANNEL):
            declarations[declared] = position
            declared += 1
        position += HEAD_BYTES + length
    sizes[0], sizes[1], sizes[2] = count, declared, channels
    return position


def _channel(data: NDArray[np.uint8], position: int) -> int:
    """Return the channel of the message at a position."""
    return word(data, position + 9) & 0xFFFF


def _sort(
    data: NDArray[np.uint8],
    found: NDArray[np.int64],
    messages: NDArray[np.int64],
    counts: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """Group the found messages by channel, and count them; `places` is working memory."""
    for row in range(len(messages)):
        counts[_channel(data, found[row])] += 1
    for channel in range(len(counts)):
        places[channel + 1] = places[channel] + counts[channel]
    for row in range(len(messages)):
        channel = _channel(data, found[row])
        messages[places[channel]] = found[row]
        places[channel] += 1


def _agree(
    data: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    places: NDArray[np.int64],
    expected: NDArray[np.int64],
    mask: NDArray[np.int64],
) -> bool:
    """Test whether all records have the expected words where the mask is set."""
    for row in range(len(offsets)):
        wrong = 0
        for k in range(len(places)):
            wrong |= (word(data, offsets[row] + places[k]) ^ expected[k]) & mask[k]
        if wrong:
            return False
    return True
