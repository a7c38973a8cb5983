"""Writing logs: whole chunks at a time, and never half a file.

A log is written as NAME.mcap.part and renamed when it is whole. The container's small records are mcap's
own; the wide ones (messages and their indexes) come from `packing`.
"""

import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from recorders.errors import BadInput
from recorders.log.ahead import ahead
from recorders.log.chunks import COMPRESSIONS, MAGIC, chunk_record
from recorders.log.layout import layout_of
from recorders.log.packing import Chunk, chunks_of
from recorders.log.run import RECORD_NAME, RunMetadata
from recorders.log.schemas import Schema
from recorders.log.sealed import PUBLISH_SPANS, seal
from recorders.log.streams import Stream, check_stream

LIBRARY = "fuselog"


@dataclass
class _Channel:
    """What the writer must remember of one topic."""

    record: records.Channel
    schema: Schema
    widths: dict[str, int]
    messages: int = 0


class LogWriter:
    """Writes one log; use it as a context manager, and the log appears whole or not at all.

    Args:
        path: the log to write; an existing file is replaced at the end, in one step.
        run: what the run was.
        compression: "zstd", "lz4" or "none".
        chunk_bytes: about how large an uncompressed chunk gets.

    Raises BadInput where the file cannot be written.
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
        self._run = None if run is None else run.to_record()
        self._compression = compression
        self._chunk_bytes = chunk_bytes
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[bytes, records.Schema] = {}
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._publish_spans: dict[str, str] = {}
        self._offset = 0
        self._checksum = 0
        self._failure: BadInput | None = None
        self._file: BinaryIO

    def __enter__(self) -> Self:
        with self._telling():
            if self.path.is_dir():
                raise BadInput(f"{self.path}: is a folder; give the name of a log in it")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._part.open("wb")
        self._append(MAGIC)
        self._append_record(records.Header(profile="", library=LIBRARY))
        if self._run is not None:
            self._append_metadata(RECORD_NAME, self._run)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self._finish()
        finally:
            # Gone already where the log was finished.
            with suppress(OSError):
                self._file.close()
            self._part.unlink(missing_ok=True)

    def write(self, streams: Iterable[Stream]) -> None:
        """Write a block of streams, merged in log-time order; ties keep the order given.

        The chunks that this block fills are in the file when the call returns, so that memory holds one
        block and a cut-off file holds the blocks before it.

        Raises BadInput where a stream breaks its schema (see `check_stream`), a topic comes twice, or
        changes its schema, its vectors' widths or its metadata from one block to the next.
        """
        block = list(streams)
        topics = [stream.topic for stream in block]
        if len(set(topics)) < len(topics):
            raise BadInput(
                f"{self.path}: a topic comes twice among {', '.join(topics)}; join its streams"
            )
        for stream in block:
            check_stream(stream, f"{self.path}: ")
            self._declare(stream)
        parts = []
        for stream in block:
            if len(stream):
                channel = self._channels[stream.topic]
                layout = layout_of(stream.schema, channel.widths)
                parts.append(
                    layout.build(_in_log_time_order(stream), channel.record.id, channel.messages)
                )
                channel.messages += len(stream)
        if parts:
            chunks = list(chunks_of(parts, self._chunk_bytes))
            for chunk, packed in zip(chunks, ahead(self._packed, chunks), strict=True):
                self._append_chunk(chunk, *packed)
            self._flush()

    def _packed(self, chunk: Chunk) -> tuple[bytes, bytes]:
        return chunk_record(chunk.data, chunk.log_time, self._compression)

    def _declare(self, stream: Stream) -> None:
        """Register the stream's topic, or compare it with what it was."""
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
        if known.schema.descriptor_set != stream.schema.descriptor_set:
            raise BadInput(
                f"{self.path}: topic {stream.topic} is {known.schema.full_name} and cannot become "
                f"{stream.schema.full_name}; use another topic"
            )
        if len(stream) and known.widths != widths:
            raise BadInput(
                f"{self.path}: topic {stream.topic} has vectors of widths {known.widths} and cannot "
                f"take {widths}; a stream keeps one width, use another topic"
            )
        if known.record.metadata != dict(stream.metadata):
            raise BadInput(f"{self.path}: topic {stream.topic} changes its metadata between blocks")

    def _register(self, stream: Stream, widths: dict[str, int]) -> None:
        described = stream.schema.descriptor_set
        if described not in self._schemas:
            self._schemas[described] = records.Schema(
                id=len(self._schemas) + 1,
                data=described,
                encoding="protobuf",
                name=stream.schema.full_name,
            )
            self._append_record(self._schemas[described])
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=stream.topic,
            message_encoding="protobuf",
            metadata=dict(stream.metadata),
            schema_id=self._schemas[described].id,
        )
        self._append_record(channel)
        self._channels[stream.topic] = _Channel(channel, stream.schema, widths)

    def _append_chunk(self, chunk: Chunk, head: bytes, packed: bytes) -> None:
        start = self._offset
        self._append(head)
        self._append(packed)
        index_start = self._offset
        index_offsets: dict[int, int] = {}
        for channel_id, entries in chunk.indexes.items():
            index_offsets[channel_id] = self._offset
            index_head = struct.pack(
                "<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries)
            )
            self._append(index_head + entries)
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression="" if self._compression == "none" else self._compression,
                compressed_size=len(packed),
                message_end_time=chunk.log_time.last_ns,
                message_index_length=self._offset - index_start,
                message_index_offsets=index_offsets,
                message_start_time=chunk.log_time.first_ns,
                uncompressed_size=len(chunk.data),
            )
        )
        self._publish_spans[f"{start}+{index_start - start}"] = (
            f"{chunk.publish_time.first_ns} {chunk.publish_time.last_ns}"
        )

    def _append_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        start = self._offset
        self._append_record(records.Metadata(name=name, metadata=seal(pairs)))
        length = self._offset - start
        self._metadata.append(records.MetadataIndex(offset=start, length=length, name=name))

    def _append_record(self, record: records.McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._append(builder.end())

    def _append(self, data: bytes) -> None:
        self._checksum = zlib.crc32(data, self._checksum)
        self._offset += len(data)
        with self._telling():
            self._file.write(data)

    def _flush(self) -> None:
        with self._telling():
            self._file.flush()

    def _finish(self) -> None:
        """Write what follows the last chunk, and give the file its name."""
        self._append_metadata(PUBLISH_SPANS, self._publish_spans)
        self._append_record(records.DataEnd(data_section_crc=self._checksum))
        self._append(self._summary_section())
        self._append(MAGIC)
        with self._telling():
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._part.replace(self.path)

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Tell errors of the disk as BadInput; once there was one, the log can no more be finished."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except OSError as error:
            self._failure = BadInput(f"{self.path}: cannot be written ({error.strerror})")
            raise self._failure from error

    def _summary_section(self) -> bytes:
        """The summary, the offsets of its groups, and the footer."""
        channels = [channel.record for channel in self._channels.values()]
        groups: dict[Opcode, Sequence[records.McapRecord]] = {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: channels,
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.METADATA_INDEX: self._metadata,
        }
        builder = RecordBuilder()
        offsets: list[records.SummaryOffset] = []
        for opcode, members in groups.items():
            before = builder.count
            for member in members:
                member.write(builder)
            if members:
                start, length = self._offset + before, builder.count - before
                offsets.append(
                    records.SummaryOffset(group_opcode=opcode, group_start=start, group_length=length)
                )
        offset_start = self._offset + builder.count
        for offset in offsets:
            offset.write(builder)
        section = builder.end() + struct.pack("<BQQQ", Opcode.FOOTER, 20, self._offset, offset_start)
        return section + struct.pack("<I", zlib.crc32(section))

    def _statistics(self) -> records.Statistics:
        counts = {channel.record.id: channel.messages for channel in self._channels.values()}
        return records.Statistics(
            attachment_count=0,
            channel_count=len(counts),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


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
