"""Writing logs: whole chunks at a time, and never half a file.

The container's small records are mcap's own; the wide ones (messages and their indexes) are structured
arrays. A log is written as NAME.mcap.part and renamed when it is whole.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log.layout import layout_of, windows
from recorders.log.run import RECORD_NAME, RunMetadata
from recorders.log.streams import Stream, check_stream

MAGIC = b"\x89MCAP0\r\n"
DELAYS_NAME = "fuselog.delays"
LIBRARY = "fuselog"
COMPRESSIONS: Mapping[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "lz4": lz4.frame.compress,
    "zstd": zstandard.compress,
}
INDEX_ENTRY = np.dtype([("log_time_ns", "<u8"), ("offset", "<u8")])


@dataclass
class _Channel:
    """What the writer must remember of one topic."""

    identifier: int
    schema_name: str
    widths: dict[str, int]
    metadata: dict[str, str]
    messages: int = 0
    smallest_delay_ns: int = 2**63
    largest_delay_ns: int = -(2**63)


@dataclass
class _Summary:
    """What the end of the file repeats of the rest."""

    schemas: list[records.Schema] = field(default_factory=list)
    channels: list[records.Channel] = field(default_factory=list)
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)


class LogWriter:
    """Writes one log; use it as a context manager, and the log appears whole or not at all.

    Args:
        path: the log to write; an existing file is replaced at the end, in one step.
        run: what the run was.
        compression: "zstd", "lz4" or "none".
        chunk_bytes: about how large an uncompressed chunk gets.
    """

    def __init__(
        self,
        path: str | Path,
        run: RunMetadata | None = None,
        *,
        compression: str = "zstd",
        chunk_bytes: int = 1 << 20,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise BadInput(f"compression '{compression}' is none of {', '.join(COMPRESSIONS)}")
        self.path = Path(path)
        self._part = self.path.with_name(self.path.name + ".part")
        self._run = run
        self._compression = compression
        self._chunk_bytes = chunk_bytes
        self._channels: dict[str, _Channel] = {}
        self._summary = _Summary()
        self._crc = 0
        self._first_log_time_ns = 2**63
        self._last_log_time_ns = 0
        self._file: BinaryIO

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._part.open("wb")
        except OSError as error:
            raise BadInput(f"{self.path}: cannot be written ({error.strerror})") from error
        self._append(MAGIC)
        self._append_record(records.Header(profile="", library=LIBRARY))
        if self._run is not None:
            self._append_metadata(RECORD_NAME, self._run.to_record())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if error is not None:
                raise error
            self._finish()
            os.replace(self._part, self.path)
        except OSError as failure:
            self._discard()
            raise BadInput(f"{self.path}: cannot be written ({failure.strerror})") from failure
        except BaseException:
            self._discard()
            raise

    def write(self, streams: Iterable[Stream]) -> None:
        """Write a block of streams, merged in log-time order; ties keep the order given.

        The chunks that this block fills are in the file when the call returns, so that memory holds one
        block and a cut-off file holds the blocks before it.

        Raises BadInput where a stream breaks its schema (see `check_stream`), or a topic changes its
        schema, its vectors' widths or its metadata from one block to the next.
        """
        block = list(streams)
        for stream in block:
            check_stream(stream, f"{self.path}: ")
            self._declare(stream)
        block = [_in_log_time_order(stream) for stream in block if len(stream)]
        if block:
            self._write_block(block)

    def _declare(self, stream: Stream) -> None:
        widths = {
            entry.name: stream.columns[entry.name].shape[1]
            for entry in stream.schema
            if entry.kind == "vector"
        }
        known = self._channels.get(stream.topic)
        if known is None:
            self._register(stream, widths)
            return
        if known.messages == 0:
            known.widths = widths
        if known.schema_name != stream.schema.full_name:
            raise BadInput(
                f"{self.path}: topic {stream.topic} is {known.schema_name} and cannot become "
                f"{stream.schema.full_name}; use another topic"
            )
        if len(stream) and known.widths != widths:
            raise BadInput(
                f"{self.path}: topic {stream.topic} has vectors of widths {known.widths} and cannot "
                f"take {widths}; a stream keeps one width, use another topic"
            )
        if known.metadata != dict(stream.metadata):
            raise BadInput(f"{self.path}: topic {stream.topic} changes its metadata between blocks")

    def _register(self, stream: Stream, widths: dict[str, int]) -> None:
        schemas = {schema.name: schema for schema in self._summary.schemas}
        schema = schemas.get(stream.schema.full_name)
        if schema is None:
            schema = records.Schema(
                id=len(schemas) + 1,
                data=stream.schema.descriptor_set,
                encoding="protobuf",
                name=stream.schema.full_name,
            )
            self._summary.schemas.append(schema)
            self._append_record(schema)
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=stream.topic,
            message_encoding="protobuf",
            metadata=dict(stream.metadata),
            schema_id=schema.id,
        )
        self._summary.channels.append(channel)
        self._append_record(channel)
        self._channels[stream.topic] = _Channel(channel.id, schema.name, widths, dict(stream.metadata))

    def _write_block(self, block: list[Stream]) -> None:
        packed: list[NDArray[np.void]] = []
        for stream in block:
            channel = self._channels[stream.topic]
            delays_ns = stream.log_time_ns - stream.publish_time_ns
            channel.smallest_delay_ns = min(channel.smallest_delay_ns, int(delays_ns.min()))
            channel.largest_delay_ns = max(channel.largest_delay_ns, int(delays_ns.max()))
            packed.append(
                layout_of(stream.schema, channel.widths).build(
                    channel.identifier,
                    channel.messages,
                    stream.log_time_ns,
                    stream.publish_time_ns,
                    stream.columns,
                )
            )
            channel.messages += len(stream)
        offsets = _merge(packed)
        self._write_chunks(_scatter(packed, offsets), packed, offsets)

    def _write_chunks(
        self, data: NDArray[np.uint8], packed: list[NDArray[np.void]], offsets: list[NDArray]
    ) -> None:
        """Cut the block at record borders into chunks of about `chunk_bytes`."""
        starts = np.sort(np.concatenate(offsets))
        wanted = np.arange(self._chunk_bytes, len(data), self._chunk_bytes)
        borders = np.unique(
            np.concatenate([[0], starts[np.searchsorted(starts, wanted) - 1], [len(data)]])
        )
        cuts = [np.searchsorted(each, borders) for each in offsets]
        for chunk in range(len(borders) - 1):
            begin, end = int(borders[chunk]), int(borders[chunk + 1])
            indexes: dict[int, NDArray[np.void]] = {}
            for part, each, cut in zip(packed, offsets, cuts, strict=True):
                rows = slice(cut[chunk], cut[chunk + 1])
                if rows.start < rows.stop:
                    index = np.empty(rows.stop - rows.start, INDEX_ENTRY)
                    index["log_time_ns"] = part["log_time_ns"][rows]
                    index["offset"] = each[rows] - begin
                    indexes[int(part["channel_id"][0])] = index
            self._append_chunk(data[begin:end].tobytes(), indexes)

    def _append_chunk(self, data: bytes, indexes: Mapping[int, NDArray[np.void]]) -> None:
        start = min(int(index["log_time_ns"].min()) for index in indexes.values())
        end = max(int(index["log_time_ns"].max()) for index in indexes.values())
        self._first_log_time_ns = min(self._first_log_time_ns, start)
        self._last_log_time_ns = max(self._last_log_time_ns, end)
        compression = "" if self._compression == "none" else self._compression
        chunk = records.Chunk(
            compression=compression,
            data=COMPRESSIONS[self._compression](data),
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        chunk_offset = self._file.tell()
        chunk_length = self._append_record(chunk)
        index_offsets: dict[int, int] = {}
        index_start = self._file.tell()
        for channel_id, index in indexes.items():
            index_offsets[channel_id] = self._file.tell()
            entries = index.tobytes()
            self._append(
                struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries))
                + entries
            )
        self._summary.chunks.append(
            records.ChunkIndex(
                chunk_length=chunk_length,
                chunk_start_offset=chunk_offset,
                compression=compression,
                compressed_size=len(chunk.data),
                message_end_time=end,
                message_index_length=self._file.tell() - index_start,
                message_index_offsets=index_offsets,
                message_start_time=start,
                uncompressed_size=len(data),
            )
        )

    def _append_metadata(self, name: str, values: dict[str, str]) -> None:
        offset = self._file.tell()
        length = self._append_record(records.Metadata(name=name, metadata=values))
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def _append_record(self, record: records.McapRecord) -> int:
        builder = RecordBuilder()
        record.write(builder)
        return self._append(builder.end())

    def _append(self, data: bytes) -> int:
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)
        return len(data)

    def _finish(self) -> None:
        delays = {
            topic: f"{channel.smallest_delay_ns} {channel.largest_delay_ns}"
            for topic, channel in self._channels.items()
            if channel.messages
        }
        self._append_metadata(DELAYS_NAME, delays)
        self._append_record(records.DataEnd(data_section_crc=self._crc))
        summary_start = self._file.tell()
        summary, summary_offset_start = self._summary_section(summary_start)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, summary_offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._file.write(summary + footer + struct.pack("<I", crc) + MAGIC)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _summary_section(self, start: int) -> tuple[bytes, int]:
        """The summary's bytes, and where in the file its offset group starts."""
        counts = {channel.identifier: channel.messages for channel in self._channels.values()}
        total = sum(counts.values())
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(counts),
            channel_message_counts=counts,
            chunk_count=len(self._summary.chunks),
            message_count=total,
            message_end_time=self._last_log_time_ns,
            message_start_time=self._first_log_time_ns if total else 0,
            metadata_count=len(self._summary.metadata),
            schema_count=len(self._summary.schemas),
        )
        groups: list[tuple[Opcode, list]] = [
            (Opcode.SCHEMA, self._summary.schemas),
            (Opcode.CHANNEL, self._summary.channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._summary.chunks),
            (Opcode.METADATA_INDEX, self._summary.metadata),
        ]
        builder = RecordBuilder()
        offsets: list[records.SummaryOffset] = []
        for opcode, members in groups:
            before = builder.count
            for member in members:
                member.write(builder)
            if members:
                offsets.append(
                    records.SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + before,
                        group_length=builder.count - before,
                    )
                )
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        return builder.end(), offset_start

    def _discard(self) -> None:
        self._file.close()
        self._part.unlink(missing_ok=True)


def write_log(
    path: str | Path,
    streams: Iterable[Stream],
    run: RunMetadata | None = None,
    *,
    compression: str = "zstd",
) -> None:
    """Write one log from streams that are all at hand; see `LogWriter`."""
    with LogWriter(path, run, compression=compression) as log:
        log.write(streams)


def _in_log_time_order(stream: Stream) -> Stream:
    if np.all(stream.log_time_ns[1:] >= stream.log_time_ns[:-1]):
        return stream
    return stream.take(np.argsort(stream.log_time_ns, kind="stable"))


def _merge(packed: list[NDArray[np.void]]) -> list[NDArray[np.int64]]:
    """The byte offset of every record of every stream when all are merged in log-time order."""
    times = np.concatenate([part["log_time_ns"] for part in packed])
    owners = np.repeat(np.arange(len(packed)), [len(part) for part in packed])
    owners = owners[np.argsort(times, kind="stable")]
    sizes = np.array([part.dtype.itemsize for part in packed])[owners]
    starts = np.cumsum(sizes) - sizes
    return [starts[owners == owner] for owner in range(len(packed))]


def _scatter(packed: list[NDArray[np.void]], offsets: list[NDArray[np.int64]]) -> NDArray[np.uint8]:
    """The block's bytes: every record at its offset."""
    data = np.empty(sum(part.nbytes for part in packed), np.uint8)
    for part, each in zip(packed, offsets, strict=True):
        size = part.dtype.itemsize
        windows(data, size)[each] = part.view(np.dtype((np.void, size)))
    return data
