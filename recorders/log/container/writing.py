"""Writer of an MCAP file with its records, indexes and summary; it appears completely or not at all.

The file is renamed when it is complete. The small records come from the mcap library; chunks and their
indexes come from `packing`. Source: the MCAP specification (mcap.dev/spec).
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput, CannotWrite
from fuselog.recorders.log.container.ahead import ahead
from fuselog.recorders.log.container.chunks import COMPRESSIONS, MAGIC, RECORD_HEAD, chunk_record
from fuselog.recorders.log.container.packing import INDEX_ENTRY, Chunk
from fuselog.recorders.log.container.sealed import PUBLISH_SPANS, note_span, seal

LIBRARY = "fuselog"
_INDEX_HEAD = struct.Struct("<HI")


class ContainerWriter:
    """A writer of one MCAP file; use it as a context manager.

    Raises BadInput if the file cannot be written, or the compression is unknown.
    """

    def __init__(self, path: Path, compression: str) -> None:
        if compression not in COMPRESSIONS:
            raise BadInput(f"compression '{compression}' is not one of {', '.join(COMPRESSIONS)}")
        self._path = path
        self._compression = compression
        self._schemas: dict[bytes, records.Schema] = {}
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._publish_spans: dict[str, str] = {}
        self._message_counts: Counter[int] = Counter()
        self._offset = 0
        self._checksum = 0
        self._failure: BadInput | None = None
        self._file: BinaryIO
        self._opened: ExitStack

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            with self._telling():
                if self._path.is_dir():
                    raise BadInput(f"{self._path}: is a folder; give the name of a log in it")
            new = stack.enter_context(whole_file(self._path))
            with self._telling():
                self._file = new.open("xb")
            stack.callback(self._close)
            self._append(MAGIC)
            self._append_record(records.Header(profile="", library=LIBRARY))
            self._opened = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None:
            self._opened.__exit__(kind, error, traceback)
            return
        with self._opened:
            self._finish()

    def _close(self) -> None:
        with suppress(OSError):  # which was reported when it occurred
            self._file.close()

    def add_schema(self, name: str, description: bytes) -> int:
        """Return the number of a protobuf schema; write it if it is new."""
        if description not in self._schemas:
            number = len(self._schemas) + 1
            schema = records.Schema(id=number, data=description, encoding="protobuf", name=name)
            self._schemas[description] = schema
            self._append_record(schema)
        return self._schemas[description].id

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """Write a new channel; return its number."""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="protobuf",
            metadata=dict(metadata),
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._append_record(channel)
        return channel.id

    def add_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Write one of fuselog's metadata records."""
        start = self._offset
        self._append_record(records.Metadata(name=name, metadata=seal(pairs)))
        entry = records.MetadataIndex(offset=start, length=self._offset - start, name=name)
        self._metadata.append(entry)

    def add_chunks(self, chunks: Sequence[Chunk]) -> None:
        """Write chunks; they are in the file when the call returns."""
        for chunk, (head, body) in zip(chunks, ahead(self._packed, chunks), strict=True):
            self._add_chunk(chunk, head, body)
        with self._telling():
            self._file.flush()

    def _packed(self, chunk: Chunk) -> tuple[bytes, bytes]:
        return chunk_record(chunk.data, chunk.log_time, self._compression)

    def _add_chunk(self, chunk: Chunk, head: bytes, body: bytes) -> None:
        start = self._offset
        self._append(head)
        self._append(body)
        end = self._offset
        index_offsets = {}
        for channel_id, entries in chunk.indexes.items():
            index_offsets[channel_id] = self._offset
            index = _INDEX_HEAD.pack(channel_id, len(entries)) + entries
            self._append(RECORD_HEAD.pack(Opcode.MESSAGE_INDEX, len(index)) + index)
            self._message_counts[channel_id] += len(entries) // INDEX_ENTRY.itemsize
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=end - start,
                chunk_start_offset=start,
                compression="" if self._compression == "none" else self._compression,
                compressed_size=len(body),
                message_end_time=chunk.log_time.last_ns,
                message_index_length=self._offset - end,
                message_index_offsets=index_offsets,
                message_start_time=chunk.log_time.first_ns,
                uncompressed_size=len(chunk.data),
            )
        )
        key, noted = note_span(start, end - start, chunk.publish_time)
        self._publish_spans[key] = noted

    def _append_record(self, record: records.McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._append(builder.end())

    def _append(self, data: bytes) -> None:
        self._checksum = zlib.crc32(data, self._checksum)
        self._offset += len(data)
        with self._telling():
            self._file.write(data)

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Raise disk errors as BadInput, immediately and at every later access to the file."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except OSError as error:
            self._failure = CannotWrite(f"{self._path}: cannot be written ({error.strerror})")
            raise self._failure from error

    def _finish(self) -> None:
        """Write everything after the last chunk."""
        self.add_metadata(PUBLISH_SPANS, self._publish_spans)
        self._append_record(records.DataEnd(data_section_crc=self._checksum))
        self._append(self._summary_section())
        self._append(MAGIC)
        with self._telling():
            self._file.close()

    def _summary_section(self) -> bytes:
        """Encode the summary, the offsets of its groups, and the footer."""
        groups: dict[Opcode, Sequence[records.McapRecord]] = {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: self._channels,
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.METADATA_INDEX: self._metadata,
        }
        builder = RecordBuilder()
        offsets = []
        for opcode, members in groups.items():
            before = builder.count
            for member in members:
                member.write(builder)
            start, length = self._offset + before, builder.count - before
            if length:
                offsets.append(records.SummaryOffset(opcode, start, length))
        offset_start = self._offset + builder.count
        for offset in offsets:
            offset.write(builder)
        section = builder.end() + struct.pack("<BQQQ", Opcode.FOOTER, 20, self._offset, offset_start)
        return section + struct.pack("<I", zlib.crc32(section))

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={
                channel.id: self._message_counts[channel.id] for channel in self._channels
            },
            chunk_count=len(self._chunks),
            message_count=self._message_counts.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
