"""Packing of streams into chunks: merged in log-time order, cut between records, and indexed."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log.container.chunks import Span
from fuselog.recorders.log.layout import windows

INDEX_ENTRY = np.dtype([("log_time_ns", "<u8"), ("offset", "<u8")])


class Chunk(NamedTuple):
    """The records of one chunk, its spans of time, and its message indexes by channel."""

    data: memoryview
    log_time: Span
    publish_time: Span
    indexes: dict[int, bytes]


def chunks_of(parts: Sequence[NDArray[np.void]], chunk_bytes: int) -> Iterator[Chunk]:
    """Merge the message records of several channels into chunks.

    Args:
        parts: records of each channel, as returned by `Layout.build`, in log-time order; ties keep the
            order given.
        chunk_bytes: approximate size of a chunk.
    """
    lengths = [len(part) for part in parts]
    log_times = np.concatenate([part["mcap log_time"] for part in parts])
    order = np.argsort(log_times, kind="stable")
    log_times = log_times[order]
    publish_times = np.concatenate([part["mcap publish_time"] for part in parts])[order]
    sizes = np.repeat([part.dtype.itemsize for part in parts], lengths)[order]
    starts = np.cumsum(sizes) - sizes
    offsets = np.empty_like(starts)
    offsets[order] = starts
    offsets_of_parts = np.split(offsets, np.cumsum(lengths)[:-1])
    data = _merged(parts, offsets_of_parts)

    wanted = np.arange(0, len(data), chunk_bytes)
    first_rows = np.unique(np.searchsorted(starts, wanted, side="right") - 1)
    last_rows = np.append(first_rows[1:], len(starts)) - 1
    borders = np.append(starts[first_rows], len(data))
    log_spans = zip(log_times[first_rows].tolist(), log_times[last_rows].tolist(), strict=True)
    publish_spans = zip(
        np.minimum.reduceat(publish_times, first_rows).tolist(),
        np.maximum.reduceat(publish_times, first_rows).tolist(),
        strict=True,
    )
    indexes = _indexes(parts, offsets_of_parts, borders)
    for number, (log_span, publish_span) in enumerate(zip(log_spans, publish_spans, strict=True)):
        yield Chunk(
            data.data[borders[number] : borders[number + 1]],
            Span(*log_span),
            Span(*publish_span),
            indexes[number],
        )


def _merged(
    parts: Sequence[NDArray[np.void]], offsets: Sequence[NDArray[np.int64]]
) -> NDArray[np.uint8]:
    """Combine the bytes of the parts, with every record at its offset."""
    data = np.empty(sum(part.nbytes for part in parts), np.uint8)
    for part, each in zip(parts, offsets, strict=True):
        places = windows(data, part.dtype.itemsize)
        places[each] = part.view(places.dtype)
    return data


def _indexes(
    parts: Sequence[NDArray[np.void]], offsets: Sequence[NDArray[np.int64]], borders: NDArray[np.int64]
) -> list[dict[int, bytes]]:
    """Encode every message's log time and its offset in the chunk, by chunk and channel."""
    found: list[dict[int, bytes]] = [{} for _ in borders[1:]]
    for part, each in zip(parts, offsets, strict=True):
        cuts = np.searchsorted(each, borders)
        entries = np.empty(len(part), INDEX_ENTRY)
        entries["log_time_ns"] = part["mcap log_time"]
        entries["offset"] = each - np.repeat(borders[:-1], np.diff(cuts))
        for index, begin, end in zip(found, cuts[:-1], cuts[1:], strict=True):
            if begin < end:
                index[int(part["mcap channel_id"][0])] = entries[begin:end].tobytes()
    return found
