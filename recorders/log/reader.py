"""Reading logs as columns, block by block in time order, with memory bounded by the blocks in hand.

Two things are taken on trust only after a check, and done the slow way where the check fails: where the
messages of a channel are (its index, else a walk over the records), and how they are laid out (our fixed
layout, else the protobuf library). A foreign log is read slowly, never wrongly.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from google.protobuf.message import DecodeError, Message
from mcap import records
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log.container import (
    Container,
    Damaged,
    Region,
    indexed_offsets,
    message_at,
    open_container,
    read_region,
    walked_offsets,
)
from recorders.log.layout import Layout, layout_of
from recorders.log.run import RECORD_NAME, RunMetadata
from recorders.log.schemas import SCHEMAS, Field, message_class, schema_from_descriptor
from recorders.log.streams import (
    Stream,
    check_stream,
    concatenate,
    empty_stream,
    total_messages,
)
from recorders.log.writer import DELAYS_NAME

Order = Literal["publish_time", "log_time"]
_Decoded = tuple[NDArray, NDArray, dict[str, NDArray]]


@dataclass
class Losses:
    """What a recovering read could not read; it fills as the log is read."""

    damages: list[str] = field(default_factory=list)

    def note(self, damage: str) -> None:
        """Note a damaged chunk once, however often it is met."""
        if damage not in self.damages:
            self.damages.append(damage)


@dataclass(frozen=True)
class Topic:
    """One topic of a log; MCAP allows several channels to share it."""

    name: str
    schema_name: str
    encoding: str
    channel_ids: tuple[int, ...]
    metadata: Mapping[str, str]
    messages: int | None


@dataclass(frozen=True)
class Log:
    """An opened log: what it holds, not the messages themselves."""

    path: Path
    container: Container
    recover: bool
    losses: Losses = field(default_factory=Losses)

    @cached_property
    def run(self) -> RunMetadata | None:
        """What the run was, where the log says so."""
        record = self.container.metadata.get(RECORD_NAME)
        return None if record is None else RunMetadata.from_record(record, self.path)

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """The topics by name, sorted."""
        grouped: dict[str, list[records.Channel]] = {}
        for channel in self.container.channels.values():
            grouped.setdefault(channel.topic, []).append(channel)
        return {name: self._topic(name, grouped[name]) for name in sorted(grouped)}

    def _topic(self, name: str, channels: list[records.Channel]) -> Topic:
        first = channels[0]
        schema = self.container.schemas.get(first.schema_id)
        if any(channel.schema_id != first.schema_id for channel in channels):
            raise BadInput(f"{self.path}: topic {name} has channels of different schemas")
        counts = [self.container.message_counts.get(channel.id, 0) for channel in channels]
        return Topic(
            name,
            schema.name if schema else "",
            first.message_encoding,
            tuple(channel.id for channel in channels),
            first.metadata,
            sum(counts) if self.container.message_counts else None,
        )

    def require(self, topic: str) -> Topic:
        """The topic of this name; raises BadInput that lists what there is."""
        if topic not in self.topics:
            raise BadInput(
                f"{self.path}: no topic {topic}; it has {', '.join(self.topics) or 'no topics'}"
            )
        return self.topics[topic]

    @property
    def loss_statement(self) -> str | None:
        """What is missing from a recovered log, in one sentence; None where nothing is."""
        parts = []
        if not self.container.whole:
            parts.append(
                f"it was cut off: the last {self.container.lost_bytes} bytes hold no whole chunk"
            )
        if self.losses.damages:
            parts.append(f"left out: {', '.join(self.losses.damages)}")
        return f"{self.path}: {' and '.join(parts)}" if parts else None


def open_log(path: str | Path, *, recover: bool = False) -> Log:
    """Open a log.

    Args:
        path: an MCAP file.
        recover: read what is readable of a file that was cut off or damaged.

    Raises BadInput where the file is missing or no MCAP, or was cut off and `recover` is False.
    """
    path = Path(path)
    container = open_container(path)
    if not container.whole and not recover:
        chunks = len(container.regions)
        raise BadInput(
            f"{path}: the log was cut off; {chunks} whole {'chunk is' if chunks == 1 else 'chunks are'} "
            f"readable with --recover, the last {container.lost_bytes} bytes are lost"
        )
    return Log(path, container, recover)


def read_streams(
    log: Log,
    topics: Sequence[str],
    *,
    order: Order = "publish_time",
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> dict[str, Stream]:
    """Read topics whole, each in time order; see `read_blocks`. A topic without messages is empty."""
    parts: dict[str, list[Stream]] = {topic: [] for topic in topics}
    for block in read_blocks(log, topics, order=order, start_ns=start_ns, end_ns=end_ns):
        for topic, stream in block.items():
            parts[topic].append(stream)
    return {
        topic: concatenate(found) if found else read_empty(log, topic) for topic, found in parts.items()
    }


def read_blocks(
    log: Log,
    topics: Sequence[str],
    *,
    order: Order = "publish_time",
    start_ns: int | None = None,
    end_ns: int | None = None,
    block_messages: int = 1 << 18,
) -> Iterator[dict[str, Stream]]:
    """Read topics in blocks that follow one another in time.

    Every block holds all messages of its span, sorted by the clock `order`, equal stamps in file order;
    no stamp is split between blocks. Topics without messages in a block are absent from it.

    Args:
        log: from `open_log`.
        topics: names of topics.
        order: the clock to sort by.
        start_ns: leave out messages before this stamp of that clock.
        end_ns: leave out messages at or after this stamp of that clock.
        block_messages: about how many messages a block has.

    Raises BadInput for an unknown topic, a schema that is not numeric columns, NaN that the schema does
    not allow, or a damaged chunk (unless the log was opened with recover).
    """
    decoders = [
        _Decoder(log, topic, identifier)
        for topic in topics
        for identifier in log.require(topic).channel_ids
    ]
    smallest_delay_ns, largest_delay_ns = 0, 0
    if order == "publish_time":
        smallest_delay_ns, largest_delay_ns = _delays(log, topics, decoders)
    regions = sorted(enumerate(log.container.regions), key=lambda ranked: ranked[1].start_log_time_ns)
    pending: dict[str, list[Stream]] = {}
    waiting, threshold = 0, block_messages
    with log.path.open("rb") as file:
        for number, (rank, region) in enumerate(regions):
            if _may_hold(region, start_ns, end_ns, smallest_delay_ns, largest_delay_ns):
                for stream in _decode_region(log, file, region, rank, decoders):
                    pending.setdefault(stream.topic, []).append(stream)
                    waiting += len(stream)
            is_last = number + 1 == len(regions)
            if not pending or (waiting < threshold and not is_last):
                continue
            limit = None if is_last else regions[number + 1][1].start_log_time_ns - largest_delay_ns
            block, pending = _release(pending, order, limit)
            block = _within(block, order, start_ns, end_ns)
            waiting = sum(total_messages(parts) for parts in pending.values())
            threshold = max(block_messages, 2 * waiting)
            if block:
                yield block


def _may_hold(
    region: Region,
    start_ns: int | None,
    end_ns: int | None,
    smallest_delay_ns: int,
    largest_delay_ns: int,
) -> bool:
    """Whether a region can hold a stamp within the range: stamp = log time - delay."""
    if start_ns is not None and region.end_log_time_ns - smallest_delay_ns < start_ns:
        return False
    return end_ns is None or region.start_log_time_ns - largest_delay_ns < end_ns


def _release(
    pending: dict[str, list[Stream]], order: Order, limit: int | None
) -> tuple[dict[str, Stream], dict[str, list[Stream]]]:
    """Split what is pending into sorted streams before `limit` and the rest."""
    block: dict[str, Stream] = {}
    rest: dict[str, list[Stream]] = {}
    for topic, parts in pending.items():
        stream = _sorted_by(concatenate(parts), order)
        cut = len(stream) if limit is None else int(np.searchsorted(_clock(stream, order), limit))
        if cut:
            block[topic] = stream.take(slice(0, cut))
        if cut < len(stream):
            rest[topic] = [stream.take(slice(cut, len(stream)))]
    return block, rest


def _within(
    block: dict[str, Stream], order: Order, start_ns: int | None, end_ns: int | None
) -> dict[str, Stream]:
    if start_ns is None and end_ns is None:
        return block
    kept: dict[str, Stream] = {}
    for topic, stream in block.items():
        clock = _clock(stream, order)
        begin = 0 if start_ns is None else int(np.searchsorted(clock, start_ns))
        end = len(stream) if end_ns is None else int(np.searchsorted(clock, end_ns))
        if begin < end:
            kept[topic] = stream.take(slice(begin, end))
    return kept


def _clock(stream: Stream, order: Order) -> NDArray[np.int64]:
    return stream.publish_time_ns if order == "publish_time" else stream.log_time_ns


def _sorted_by(stream: Stream, order: Order) -> Stream:
    clock = _clock(stream, order)
    later = clock[1:] > clock[:-1]
    tied = (clock[1:] == clock[:-1]) & (stream.position[1:] > stream.position[:-1])
    if np.all(later | tied):
        return stream
    return stream.take(np.lexsort((stream.position, clock)))


def _delays(log: Log, topics: Sequence[str], decoders: list["_Decoder"]) -> tuple[int, int]:
    """Smallest and largest log time - publish time over the topics; measured where not stated."""
    stated = log.container.metadata.get(DELAYS_NAME, {})
    if all(topic in stated or log.topics[topic].messages == 0 for topic in topics):
        try:
            pairs = [tuple(map(int, stated[topic].split())) for topic in topics if topic in stated]
            return min((low for low, _ in pairs), default=0), max((top for _, top in pairs), default=0)
        except ValueError as error:
            raise BadInput(f"{log.path}: the metadata record '{DELAYS_NAME}' is damaged") from error
    smallest, largest = 2**63, -(2**63)
    with log.path.open("rb") as file:
        for rank, region in enumerate(log.container.regions):
            for stream in _decode_region(log, file, region, rank, decoders):
                delays = stream.log_time_ns - stream.publish_time_ns
                smallest = min(smallest, int(delays.min()))
                largest = max(largest, int(delays.max()))
    return (smallest, largest) if smallest <= largest else (0, 0)


def read_empty(log: Log, topic: str) -> Stream:
    """A topic without its messages: its schema and metadata."""
    found = log.require(topic)
    return empty_stream(topic, _Decoder(log, topic, found.channel_ids[0]).schema, found.metadata)


class _Decoder:
    """Decodes one channel of a log, region by region."""

    def __init__(self, log: Log, topic: str, channel_id: int) -> None:
        self._log = log
        self._topic = log.require(topic)
        self.channel_id = channel_id
        self._layout: Layout | None = None
        record = log.container.schemas.get(log.container.channels[channel_id].schema_id)
        if record is None or record.encoding != "protobuf" or self._topic.encoding != "protobuf":
            raise BadInput(
                f"{log.path}: topic {topic} is {self._topic.schema_name or 'without a schema'} in the "
                f"encoding '{self._topic.encoding}'; fuselog replays protobuf messages with numeric "
                "fields, import other logs first"
            )
        try:
            self.schema = schema_from_descriptor(record.data, record.name)
            self._is_ours = self.schema.descriptor_set == record.data
            self._message_class = message_class(record.data, record.name)
        except (DecodeError, KeyError, TypeError) as error:
            raise BadInput(
                f"{log.path}: topic {topic}: the description of {record.name} is damaged ({error})"
            ) from error
        self._check_fields(record.name)

    def _check_fields(self, schema_name: str) -> None:
        """A message of one of our names must have our fields, whatever else it has."""
        expected = SCHEMAS.get(schema_name, self.schema)
        kinds = {entry.name: entry.kind for entry in self.schema}
        wrong = [entry.name for entry in expected if kinds.get(entry.name) != entry.kind]
        if wrong or not kinds:
            raise BadInput(
                f"{self._log.path}: topic {self._topic.name}: this {schema_name} has no numeric "
                f"field {', '.join(wrong) or 'at all'}; it was written with another schema, "
                "record or import it again"
            )

    def decode(self, data: NDArray[np.uint8], offsets: NDArray[np.int64], rank: int) -> Stream | None:
        """The channel's messages of a region, in file order; None where it has none.

        Raises Damaged where `offsets` do not lead to this channel's messages.
        """
        if len(offsets) == 0:
            return None
        decoded = self._decode_at_once(data, offsets) or self._decode_one_by_one(data, offsets)
        log_time_ns, publish_time_ns, columns = decoded
        stream = Stream(
            self._topic.name,
            self.schema,
            publish_time_ns.astype(np.int64),
            log_time_ns.astype(np.int64),
            columns,
            (rank << 32) + offsets,
            self._topic.metadata,
        )
        check_stream(stream, f"{self._log.path}: ")
        return stream

    def _decode_at_once(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> _Decoded | None:
        """Columns by the fixed layout; None where a message is laid out in another way."""
        if not self._is_ours:
            return None
        if self._layout is None:
            first = self._message(data, int(offsets[0]))[2]
            vectors = [entry.name for entry in self.schema if entry.kind == "vector"]
            self._layout = layout_of(self.schema, {name: len(getattr(first, name)) for name in vectors})
        found = self._layout.parse(data, offsets, self.channel_id)
        if found is None:
            return None
        return found["log_time_ns"], found["publish_time_ns"], self._layout.columns(found)

    def _decode_one_by_one(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> _Decoded:
        """Columns through the protobuf library, whatever the order and presence of the fields."""
        found = [self._message(data, int(offset)) for offset in offsets]
        times = np.array([(log_time, publish_time) for log_time, publish_time, _ in found], np.uint64)
        messages = [message for _, _, message in found]
        columns = {entry.name: self._column(entry, messages) for entry in self.schema}
        return times[:, 0], times[:, 1], columns

    def _message(self, data: NDArray[np.uint8], offset: int) -> tuple[int, int, Message]:
        channel_id, log_time, publish_time, payload = message_at(data, offset)
        if channel_id != self.channel_id:
            raise Damaged("a message index points at a message of another channel")
        try:
            return log_time, publish_time, self._message_class.FromString(payload)
        except DecodeError as error:
            raise Damaged(
                f"a message of topic {self._topic.name} is no {self.schema.full_name}"
            ) from error

    def _column(self, entry: Field, messages: list[Message]) -> NDArray:
        values = [getattr(message, entry.name) for message in messages]
        if entry.kind == "vector":
            widths = {len(value) for value in values}
            if len(widths) > 1:
                raise BadInput(
                    f"{self._log.path}: topic {self._topic.name}: field {entry.name} has vectors of "
                    f"different lengths {sorted(widths)}; a stream keeps one, split the topic"
                )
            return np.array([list(value) for value in values], entry.dtype).reshape(len(values), -1)
        if self._message_class.DESCRIPTOR.fields_by_name[entry.name].has_presence:
            absent = np.array([not message.HasField(entry.name) for message in messages])
            if absent.any() and entry.kind != "real":
                raise BadInput(
                    f"{self._log.path}: topic {self._topic.name}: field {entry.name} is absent from "
                    f"{int(absent.sum())} messages; write every field"
                )
            if absent.any():
                return np.where(absent, np.nan, np.array(values, entry.dtype))
        return np.array(values, entry.dtype)


def _decode_region(
    log: Log, file: BinaryIO, region: Region, rank: int, decoders: Sequence[_Decoder]
) -> list[Stream]:
    """The messages of a region, one stream per channel that has any; it is read at most once."""
    indexed = indexed_offsets(file, region, [decoder.channel_id for decoder in decoders])
    if indexed is not None and not any(len(found) for found in indexed.values()):
        return []
    try:
        data = read_region(file, region)
        offsets = walked_offsets(data) if indexed is None else indexed
        nothing = np.empty(0, np.int64)
        streams = [
            decoder.decode(data, offsets.get(decoder.channel_id, nothing), rank) for decoder in decoders
        ]
    except Damaged as damage:
        if not log.recover:
            raise BadInput(f"{log.path}: {damage}; what is whole is readable with --recover") from damage
        log.losses.note(f"{damage}")
        return []
    return [stream for stream in streams if stream is not None]
