"""Foxglove mirrors: messages in Foxglove's schemas, written next to a log's streams for viewers.

The channel of a mirror states in its metadata which stream it accompanies, and is not one of the log's
topics. Its messages have no fixed layout, and are written one by one into separate chunks.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2
from google.protobuf.message import Message
from mcap.opcode import Opcode

from fuselog.recorders.log.container.chunks import RECORD_HEAD, Span
from fuselog.recorders.log.container.packing import INDEX_ENTRY, Chunk

# The key in a channel's metadata that names the stream.
MIRROR_OF = "companion_of"
# Opcode, length of the rest, channel, sequence number, log time, publish time.
_HEAD = struct.Struct("<BQHIQQ")


class Mirror(NamedTuple):
    """A message, its topic, the topic of the stream that it accompanies, and its two clocks."""

    topic: str
    of: str
    message: Message
    log_time_ns: int
    publish_time_ns: int


class Numbered(NamedTuple):
    """A Foxglove mirror with its channel, and its sequence number in that channel."""

    channel_id: int
    sequence: int
    mirror: Mirror


def descriptor_set(message: Message) -> bytes:
    """Return the serialised FileDescriptorSet of a message with all of its dependencies."""
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}

    def add(file: Any) -> None:
        for needed in file.dependencies:
            add(needed)
        if file.name not in files:
            files[file.name] = descriptor_pb2.FileDescriptorProto.FromString(file.serialized_pb)

    add(message.DESCRIPTOR.file)
    return descriptor_pb2.FileDescriptorSet(file=files.values()).SerializeToString(deterministic=True)


def chunks_of_mirrors(mirrors: Sequence[Numbered], chunk_bytes: int) -> Iterator[Chunk]:
    """Yield chunks of about `chunk_bytes`, in the order of log time; ties keep the order given."""
    rows: list[tuple[Numbered, bytes]] = []
    size = 0
    for row in sorted(mirrors, key=lambda each: each.mirror.log_time_ns):
        data = row.mirror.message.SerializeToString(deterministic=True)
        rows.append((row, data))
        size += _HEAD.size + len(data)
        if size >= chunk_bytes:
            yield _chunk(rows)
            rows, size = [], 0
    if rows:
        yield _chunk(rows)


def _chunk(rows: Sequence[tuple[Numbered, bytes]]) -> Chunk:
    data = bytearray()
    entries: dict[int, list[tuple[int, int]]] = {}
    for (channel_id, sequence, mirror), message in rows:
        clocks = mirror.log_time_ns, mirror.publish_time_ns
        entries.setdefault(channel_id, []).append((mirror.log_time_ns, len(data)))
        length = _HEAD.size - RECORD_HEAD.size + len(message)
        data += _HEAD.pack(Opcode.MESSAGE, length, channel_id, sequence, *clocks) + message
    published = [row.mirror.publish_time_ns for row, _ in rows]
    return Chunk(
        memoryview(data),
        Span(rows[0][0].mirror.log_time_ns, rows[-1][0].mirror.log_time_ns),
        Span(min(published), max(published)),
        {channel: np.array(each, INDEX_ENTRY).tobytes() for channel, each in entries.items()},
    )
