"""Reader of logs as columns, block by block in time order, with only a few blocks in memory."""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import BinaryIO, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.container.ahead import ahead
from fuselog.recorders.log.container.chunks import Contents, Damaged, Span, open_region
from fuselog.recorders.log.container.reading import Region, read_bytes
from fuselog.recorders.log.container.sealed import PUBLISH_SPANS, noted_span
from fuselog.recorders.log.decoding import Decoder
from fuselog.recorders.log.opening import Log
from fuselog.recorders.log.streams import Clock, Stream, check_stream, concatenate
from fuselog.recorders.remote.paths import open_binary

# Contains every stamp that MCAP can store.
_ALWAYS = Span(-1, 1 << 64)


class _Window(NamedTuple):
    """The requested span of stamps, and its clock."""

    clock: Clock
    span: Span


class _Ranked(NamedTuple):
    """A region, and its rank in the file."""

    rank: int
    region: Region


def read_streams(
    log: Log,
    topics: Sequence[str],
    *,
    order: Clock = "publish_time",
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> dict[str, Stream]:
    """Read whole topics, each in time order; see `read_blocks`. A topic without messages is empty.

    >>> from fuselog.recorders.log import make_stream, open_log, schemas, write_log
    >>> seen = make_stream("/range", schemas.RANGE, [20, 0, 10], target_id=[1, 1, 1], range_m=[5, 3, 4])
    >>> write_log("run.mcap", [seen])
    >>> read_streams(open_log("run.mcap"), ["/range"], start_ns=10)["/range"]["range_m"].tolist()
    [4.0, 5.0]
    """
    blocks = read_blocks(
        log, topics, order=order, start_ns=start_ns, end_ns=end_ns, block_messages=sys.maxsize
    )
    (whole,) = list(blocks) or [{}]
    return {topic: whole.get(topic) or read_empty(log, topic) for topic in topics}


def read_span(log: Log, clock: Clock) -> tuple[int, int]:
    """Find the first and last stamp of a log in ns by one of its clocks; both are 0 without messages.

    Files of other writers state only the log times of chunks, so their chunks are opened to find publish
    times. Raises BadInput if a chunk is damaged.
    """
    regions = log.container.regions
    with _reading(log) as file:
        for rank, region in enumerate(regions):
            regions[rank] = _timed(log, file, region, clock)
    spans = [region.spans[clock] for region in regions if clock in region.spans]
    first_ns = min((span.first_ns for span in spans), default=0)
    return first_ns, max((span.last_ns for span in spans), default=0)


def read_empty(log: Log, topic: str) -> Stream:
    """Return a topic without messages, with its schema and metadata."""
    return Decoder(log, topic).empty()


def read_blocks(
    log: Log,
    topics: Sequence[str],
    *,
    order: Clock = "publish_time",
    start_ns: int | None = None,
    end_ns: int | None = None,
    block_messages: int = 1 << 18,
) -> Iterator[dict[str, Stream]]:
    """Read topics in blocks that follow one another in time.

    Every block contains all messages of its span, sorted by the clock `order`, with equal stamps in file
    order; messages with equal stamps are in one block. Topics without messages in a block are absent
    from it.

    Args:
        log: log from `open_log`.
        topics: names of topics.
        order: clock to sort by.
        start_ns: messages before this stamp of that clock are left out.
        end_ns: messages at or after this stamp of that clock are left out.
        block_messages: approximate number of messages in a block.

    Raises BadInput for an unknown topic, a schema without numeric columns, NaN that the schema does not
    allow, or a damaged file.
    """
    decoders = [Decoder(log, topic) for topic in dict.fromkeys(topics)]
    window = _Window(
        order,
        Span(
            _ALWAYS.first_ns if start_ns is None else start_ns,
            _ALWAYS.last_ns if end_ns is None else end_ns - 1,
        ),
    )
    pending: dict[str, list[Stream]] = {}
    counts: Counter[str] = Counter()
    waiting, threshold = 0, block_messages
    with _reading(log) as file:
        chosen = _chosen(log, file, topics, window)
        reads = ((ranked, read_bytes(file, *ranked.region.extent)) for ranked in chosen)
        work = partial(_decoded, log, decoders, window)
        for number, found in enumerate(ahead(work, reads), start=1):
            for stream in found:
                pending.setdefault(stream.topic, []).append(stream)
                counts[stream.topic] += len(stream)
                waiting += len(stream)
            is_last = number == len(chosen)
            if not is_last and waiting < threshold:
                continue
            limit_ns = None if is_last else chosen[number].region.spans[order].first_ns
            block, pending = _released(log, pending, order, limit_ns)
            waiting = sum(len(stream) for parts in pending.values() for stream in parts)
            threshold = max(block_messages, 2 * waiting)
            if block:
                yield block
    if window.span == _ALWAYS:
        _check_counts(log, topics, counts)


@contextmanager
def _reading(log: Log) -> Iterator[BinaryIO]:
    try:
        with open_binary(log.path) as file:
            yield file
    except OSError as error:
        raise BadInput(f"{log.path}: cannot be read ({error.strerror})") from error


def _chosen(log: Log, file: BinaryIO, topics: Sequence[str], window: _Window) -> list[_Ranked]:
    """Choose the regions that may contain requested messages, in the order of their start times."""
    wanted = {identifier for topic in topics for identifier in log.topics[topic].channel_ids}
    chosen = []
    for rank, region in enumerate(log.container.regions):
        if region.channel_ids is None or not wanted.isdisjoint(region.channel_ids):
            timed = log.container.regions[rank] = _timed(log, file, region, window.clock)
            if window.clock in timed.spans and window.span.meets(timed.spans[window.clock]):
                chosen.append(_Ranked(rank, timed))
    return sorted(chosen, key=lambda ranked: ranked.region.spans[window.clock].first_ns)


def _timed(log: Log, file: BinaryIO, region: Region, clock: Clock) -> Region:
    """Return the region with its span by the clock: known, noted by fuselog, or read from the region."""
    if clock in region.spans:
        return region
    noted = noted_span(log.container.metadata.get(PUBLISH_SPANS, {}), *region.extent)
    if noted is not None:
        return replace(region, spans={**region.spans, "publish_time": noted})
    contents = _contents(log, region, read_bytes(file, *region.extent))
    return replace(region, spans=contents.spans)


def _contents(log: Log, region: Region, raw: bytes) -> Contents:
    """Open the region; raise BadInput if it is damaged, or contradicts the index."""
    try:
        contents = open_region(raw, region.offset)
    except Damaged as damage:
        raise BadInput(f"{log.path}: {damage}; --recover reads the intact part") from damage
    for clock, span in contents.spans.items():
        if clock in region.spans and not region.spans[clock].holds(span):
            raise BadInput(
                f"{log.path}: the chunk at byte {region.offset} has messages outside the span in its "
                "index; --recover reads it without the index"
            )
    stated = log.container.channels.keys() if region.channel_ids is None else region.channel_ids
    for channel_id in contents.messages.keys() - stated:
        raise BadInput(
            f"{log.path}: the chunk at byte {region.offset} has messages of channel {channel_id}, which "
            "its index does not list; --recover reads it without the index"
        )
    return contents


def _decoded(
    log: Log, decoders: Sequence[Decoder], window: _Window, read: tuple[_Ranked, bytes]
) -> list[Stream]:
    """Decode the requested messages of one region."""
    (rank, region), raw = read
    contents = _contents(log, region, raw)
    found = [stream for decoder in decoders for stream in decoder.decode(contents, rank)]
    if window.span.holds(region.spans[window.clock]):
        return found
    return [_within(stream, window) for stream in found]


def _within(stream: Stream, window: _Window) -> Stream:
    times = stream.times(window.clock)
    return stream.take((times >= window.span.first_ns) & (times <= window.span.last_ns))


def _released(
    log: Log, pending: Mapping[str, list[Stream]], clock: Clock, limit_ns: int | None
) -> tuple[dict[str, Stream], dict[str, list[Stream]]]:
    """Sort pending streams, and split them into the messages before `limit_ns` and the rest."""
    block: dict[str, Stream] = {}
    rest: dict[str, list[Stream]] = {}
    for topic, parts in pending.items():
        stream = _in_order(concatenate(parts, f"{log.path}: "), clock)
        cut = len(stream) if limit_ns is None else int(np.searchsorted(stream.times(clock), limit_ns))
        if cut:
            block[topic] = stream.take(slice(0, cut))
            check_stream(block[topic], f"{log.path}: ")
        if cut < len(stream):
            rest[topic] = [stream.take(slice(cut, None))]
    return block, rest


def _in_order(stream: Stream, clock: Clock) -> Stream:
    """Sort messages by their stamps, with equal stamps in file order."""
    times, position = stream.times(clock), stream.position
    later = times[1:] > times[:-1]
    tied = (times[1:] == times[:-1]) & (position[1:] > position[:-1])
    return stream if np.all(later | tied) else stream.take(np.lexsort((position, times)))


def _check_counts(log: Log, topics: Sequence[str], counts: Mapping[str, int]) -> None:
    """Raise BadInput if a complete read found another number of messages than the file states."""
    for topic in topics:
        stated = log.topics[topic].messages
        if counts[topic] != stated:
            raise BadInput(
                f"{log.path}: topic {topic} has {stated} messages by the file's statistics, but "
                f"{counts[topic]} by its index; --recover reads it without the index"
            )
