"""The MCAP container as byte regions: where the chunks of a file are, and how much of it is whole.

A file with a summary is opened through the official reader. One without (legal, or cut off) is walked
record by record. Messages outside chunks are laid out like an uncompressed chunk, and are read as one.
"""

import io
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log.writer import INDEX_ENTRY, MAGIC


class Damaged(Exception):
    """A part of a file that cannot be read; says which and why."""


_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_LOOSE = frozenset({Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL})
# A run of messages outside chunks is cut here, so that memory stays bounded.
_LOOSE_BYTES = 1 << 20


@dataclass(frozen=True)
class Region:
    """One chunk, or one run of messages outside chunks, and what is known of it before reading."""

    offset: int
    length: int
    start_log_time_ns: int
    end_log_time_ns: int
    is_chunk: bool = True
    index_offsets: dict[int, int] = field(default_factory=dict)


@dataclass
class Container:
    """What a file holds: channels and schemas by id, metadata records by name, regions in file order."""

    channels: dict[int, records.Channel] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    regions: list[Region] = field(default_factory=list)
    message_counts: dict[int, int] = field(default_factory=dict)
    whole: bool = True
    lost_bytes: int = 0


def open_container(path: Path) -> Container:
    """Find out what `path` holds; a file that was cut off or damaged has `whole` False.

    Raises BadInput where the file is missing, unreadable, or no MCAP at all.
    """
    try:
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
            if magic != MAGIC:
                raise BadInput(f"{path}: not an MCAP file; give a log that starts with the MCAP magic")
            file.seek(0)
            return _summarised(file) or _walked(file)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from error


def _summarised(file: BinaryIO) -> Container | None:
    """What the summary says, or None where it is absent, damaged, or lacks what the regions need."""
    try:
        reader = SeekingReader(file)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None or not summary.channels:
            return None
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    except (McapError, ValueError, struct.error, KeyError, IndexError, MemoryError, OverflowError):
        return None
    if len(summary.chunk_indexes) != summary.statistics.chunk_count:
        return None
    if summary.statistics.chunk_count == 0 and summary.statistics.message_count:
        return None
    size = file.seek(0, io.SEEK_END)
    regions = [
        Region(
            index.chunk_start_offset,
            index.chunk_length,
            index.message_start_time,
            index.message_end_time,
            True,
            index.message_index_offsets,
        )
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    ]
    if any(region.offset + region.length > size for region in regions):
        return None
    return Container(
        channels=dict(summary.channels),
        schemas=dict(summary.schemas),
        metadata=metadata,
        regions=regions,
        message_counts=dict(summary.statistics.channel_message_counts),
    )


def _walked(file: BinaryIO) -> Container:
    """Walk a file without a usable summary from its start to its last whole record."""
    size = file.seek(0, io.SEEK_END)
    found = Container(whole=False)
    position = file.seek(len(MAGIC))
    loose: list[tuple[int, int, int]] = []
    while position + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        end = position + _HEAD.size + length
        if end > size:
            break
        try:
            if opcode in _LOOSE:
                loose.append(_note_loose(found, file, opcode, position, end))
                if end - loose[0][0] > _LOOSE_BYTES:
                    _close_loose(found, loose)
            elif opcode == Opcode.CHUNK:
                _close_loose(found, loose)
                start_ns, end_ns = struct.unpack("<QQ", file.read(16))
                found.regions.append(Region(position, end - position, start_ns, end_ns))
                _note_declarations(found, file, found.regions[-1])
            elif opcode == Opcode.MESSAGE_INDEX and found.regions:
                (channel_id,) = struct.unpack("<H", file.read(2))
                found.regions[-1].index_offsets[channel_id] = position
            elif opcode == Opcode.METADATA:
                record = records.Metadata.read(ReadDataStream(file))
                found.metadata[record.name] = record.metadata
            elif opcode == Opcode.DATA_END:
                found.whole = _has_footer(file, size)
                position = end
                break
        except (ValueError, struct.error):
            break
        position = file.seek(end)
    _close_loose(found, loose)
    if not found.whole:
        found.lost_bytes = size - position
        if found.regions:  # the last chunk's indexes may be cut off
            found.regions[-1].index_offsets.clear()
    return found


def _note_loose(
    found: Container, file: BinaryIO, opcode: int, position: int, end: int
) -> tuple[int, int, int]:
    """Note a record outside chunks; returns its place and, for a message, its log time (else -1)."""
    body = file.read(end - position - _HEAD.size)
    if opcode == Opcode.MESSAGE:
        return position, end, _MESSAGE.unpack_from(body)[2]
    _declare(found, opcode, body)
    return position, end, -1


def _close_loose(found: Container, loose: list[tuple[int, int, int]]) -> None:
    times = [time for _, _, time in loose if time >= 0]
    if times:
        start, end = loose[0][0], loose[-1][1]
        found.regions.append(Region(start, end - start, min(times), max(times), is_chunk=False))
    loose.clear()


def _note_declarations(found: Container, file: BinaryIO, region: Region) -> None:
    """Schemas and channels may be declared inside a chunk; a damaged one is met again when it is read."""
    with suppress(Damaged, ValueError, struct.error):
        for opcode, body in walk_records(read_region(file, region)):
            if opcode != Opcode.MESSAGE:
                _declare(found, opcode, bytes(body))


def _declare(found: Container, opcode: int, body: bytes) -> None:
    stream = ReadDataStream(io.BytesIO(body))
    if opcode == Opcode.SCHEMA:
        schema = records.Schema.read(stream)
        found.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = records.Channel.read(stream)
        found.channels[channel.id] = channel


def _has_footer(file: BinaryIO, size: int) -> bool:
    file.seek(size - len(MAGIC))
    return file.read(len(MAGIC)) == MAGIC


def read_region(file: BinaryIO, region: Region) -> NDArray[np.uint8]:
    """The uncompressed records of one region as bytes, with the checksum compared.

    Raises Damaged where the region is damaged.
    """
    file.seek(region.offset)
    raw = file.read(region.length)
    if not region.is_chunk:
        return np.frombuffer(raw, np.uint8)
    try:
        chunk = records.Chunk.read(ReadDataStream(io.BytesIO(raw[_HEAD.size :])))
        if chunk.compression == "zstd":
            data = zstandard.decompress(chunk.data, chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            data = lz4.frame.decompress(chunk.data)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise Damaged(f"the compression '{chunk.compression}' is none of zstd, lz4 and none")
    except (McapError, ValueError, RuntimeError, struct.error, zstandard.ZstdError) as error:
        raise Damaged(f"the chunk at byte {region.offset} is damaged ({error})") from error
    if len(data) != chunk.uncompressed_size:
        raise Damaged(f"the chunk at byte {region.offset} is damaged (its size is wrong)")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damaged(f"the chunk at byte {region.offset} is damaged (its checksum is wrong)")
    return np.frombuffer(data, np.uint8)


def indexed_offsets(
    file: BinaryIO, region: Region, channel_ids: Iterable[int]
) -> dict[int, NDArray[np.int64]] | None:
    """Where the messages of the channels start, in file order, by the region's indexes.

    None where the region has no index, or one that is damaged: then the records must be walked.
    """
    if not region.index_offsets:
        return None
    found: dict[int, NDArray[np.int64]] = {}
    for channel_id in channel_ids:
        place = region.index_offsets.get(channel_id)
        offsets = np.empty(0, np.int64) if place is None else _index_record(file, place, channel_id)
        if offsets is None:
            return None
        found[channel_id] = offsets
    return found


def _index_record(file: BinaryIO, place: int, channel_id: int) -> NDArray[np.int64] | None:
    file.seek(place)
    head = file.read(_INDEX_HEAD.size)
    if len(head) < _INDEX_HEAD.size:
        return None
    opcode, length, found_channel, entry_bytes = _INDEX_HEAD.unpack(head)
    if opcode != Opcode.MESSAGE_INDEX or found_channel != channel_id or length != entry_bytes + 6:
        return None
    entries = file.read(entry_bytes)
    if len(entries) != entry_bytes or entry_bytes % INDEX_ENTRY.itemsize:
        return None
    return np.sort(np.frombuffer(entries, INDEX_ENTRY)["offset"].astype(np.int64))


def walked_offsets(data: NDArray[np.uint8]) -> dict[int, NDArray[np.int64]]:
    """Where the messages of every channel start, found by walking the region's records."""
    found: dict[int, list[int]] = {}
    position = 0
    for opcode, body in walk_records(data):
        if opcode == Opcode.MESSAGE and len(body) >= _MESSAGE.size:
            found.setdefault(_MESSAGE.unpack_from(body)[0], []).append(position)
        position += _HEAD.size + len(body)
    return {channel: np.array(offsets, np.int64) for channel, offsets in found.items()}


def walk_records(data: NDArray[np.uint8]) -> Iterator[tuple[int, memoryview]]:
    """The records of an uncompressed region: opcode and body. Raises Damaged where one overruns it."""
    view = data.data
    position = 0
    while position < len(view):
        if position + _HEAD.size > len(view):
            raise Damaged("a record inside a chunk is cut off")
        opcode, length = _HEAD.unpack_from(view, position)
        begin = position + _HEAD.size
        if begin + length > len(view):
            raise Damaged("a record inside a chunk is longer than the chunk")
        yield opcode, view[begin : begin + length]
        position = begin + length


def message_at(data: NDArray[np.uint8], offset: int) -> tuple[int, int, int, bytes]:
    """Channel, log time, publish time and payload of the message record at `offset`."""
    view = data.data
    if offset < 0 or offset + _HEAD.size + _MESSAGE.size > len(view):
        raise Damaged("a message index points outside its chunk")
    opcode, length = _HEAD.unpack_from(view, offset)
    begin = offset + _HEAD.size
    if opcode != Opcode.MESSAGE or begin + length > len(view):
        raise Damaged("a message index points at something else than a message")
    channel, _, log_time, publish_time = _MESSAGE.unpack_from(view, begin)
    return channel, log_time, publish_time, bytes(view[begin + _MESSAGE.size : begin + length])
