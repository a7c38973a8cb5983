"""Reader of the MCAP container: the regions of a file with messages, and its other contents.

The data section is walked record by record. Chunks listed in the summary are skipped; all others are
opened, so that files without an index, or with an incomplete one, are read too. Messages outside chunks
have the layout of an uncompressed chunk, and are read like one. After an incomplete record, the walk
continues at the next record whose position an intact summary states. A remote file that is read by
ranges is not walked: only the records whose positions the summary states are considered.
Source: the MCAP specification (mcap.dev/spec).
"""

import io
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from errno import EIO
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap import records
from mcap.opcode import Opcode

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.container.chunks import (
    MAGIC,
    RECORD_HEAD,
    Damaged,
    Span,
    open_region,
    read_records,
)
from fuselog.recorders.log.container.sealed import unseal
from fuselog.recorders.log.streams import Clock
from fuselog.recorders.remote.paths import RangeStream, copy_whole, open_binary

_FOOTER = struct.Struct("<BQQQI8s")
# The part of the footer covered by the summary's checksum.
_FOOTER_CHECKED_BYTES = 25
_LOOSE = frozenset({Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL})
_DATA_END_BYTES = RECORD_HEAD.size + 4
# The fields before an attachment's name: when it was logged and made, and the length of the name.
_ATTACHMENT_HEAD = struct.Struct("<QQI")
# A run of records outside chunks is split at this size, so that memory stays bounded.
_LOOSE_BYTES = 1 << 20
# No record has this opcode: it marks bytes that are not a complete record.
_LOST = 0


@dataclass(frozen=True)
class Region:
    """One chunk, or one run of records outside chunks, described without opening it.

    The span of publish times is absent if only the index of another writer describes the chunk;
    `channel_ids` is None if the index does not list the channels.
    """

    offset: int
    length: int
    spans: Mapping[Clock, Span]
    channel_ids: frozenset[int] | None

    @property
    def extent(self) -> tuple[int, int]:
        """Return offset and length in the file, for `read_bytes`."""
        return self.offset, self.length


@dataclass
class Container:
    """The contents of a file: channels and schemas by id, metadata by name, regions in file order.

    Both counts are by channel: the messages that can be read, and those that an intact summary states.
    Only the names of attachments are known.
    """

    channels: dict[int, records.Channel] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[str] = field(default_factory=list)
    regions: list[Region] = field(default_factory=list)
    message_counts: Counter[int] = field(default_factory=Counter)
    stated_counts: Counter[int] = field(default_factory=Counter)
    damages: list[str] = field(default_factory=list)


class _Place(NamedTuple):
    """One record, lost bytes, or a run of records outside chunks.

    A run has the opcode of a message, or of a schema if it has only declarations.
    """

    opcode: int
    offset: int
    length: int

    @property
    def end(self) -> int:
        """Return the position after the last byte."""
        return self.offset + self.length


class _Summary(NamedTuple):
    """The records of the summary, and its position; None if that is unknown."""

    records: Sequence[Any] = ()
    start: int | None = None


class _Index(NamedTuple):
    """The summary's entries for chunks, by position, and numbers of messages, by channel."""

    chunks: dict[int, records.ChunkIndex]
    message_counts: Counter[int]

    def chunk(self, place: _Place) -> records.ChunkIndex | None:
        """Return the index entry of the chunk at `place`; None if they do not match or it is empty."""
        entry = self.chunks.get(place.offset)
        if entry is None or (place.opcode, place.length) != (Opcode.CHUNK, entry.chunk_length):
            return None
        # a chunk without messages also states the time 0
        return entry if entry.message_end_time else None


class _NoIndex(Exception):
    """An error for files that would be read by ranges, but whose records have to be found one by one."""


class NotMcap(BadInput):
    """An error for files that are not MCAP; a command may catch it and read another format."""


def open_container(path: Path, *, use_index: bool = True) -> Container:
    """Describe a file's contents; without its index, open all regions and keep the intact ones.

    Raises BadInput if the file is missing, unreadable, or not MCAP.
    """
    try:
        with open_binary(path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise NotMcap(f"{path}: not an MCAP file; give a log that starts with the MCAP magic")
            return _opened(file, use_index)
    except _NoIndex:
        copy_whole(path, "it has no index" if use_index else "it is read without its index")
        return open_container(path, use_index=use_index)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from error


def read_bytes(file: BinaryIO, offset: int, length: int) -> bytes:
    """Read `length` bytes of `file` from `offset`; raise OSError if the file has become shorter."""
    file.seek(offset)
    found = file.read(length)
    if len(found) < length:
        raise OSError(EIO, "it became shorter while it was read")
    return found


def _opened(file: BinaryIO, use_index: bool) -> Container:
    found, summary, stated = Container(), _Summary(), _Index({}, Counter())
    size = file.seek(0, io.SEEK_END)
    damage_at_end = ""
    try:
        summary = _summary(file, size)
        _declare(found, summary.records)
        stated = _index(summary.records)
    except Damaged as damage:
        damage_at_end = str(damage)
    index = stated if use_index else _Index({}, Counter())
    is_walked = not isinstance(file, RangeStream)
    if not (is_walked or index.chunks):
        raise _NoIndex
    chunks = set()
    place = _Place(_LOST, 0, len(MAGIC))
    for place in _data_section(file, size, summary) if is_walked else _stated_places(summary):
        if place.opcode == Opcode.CHUNK:
            chunks.add(place.offset)
        try:
            _note(found, file, place, index)
        except Damaged as damage:
            found.damages.append(str(damage))
    if place.opcode != Opcode.DATA_END:
        damage_at_end = f"it was cut off: its last {size - place.end} bytes are not a complete record"
    elif place.end != summary.start:
        damage_at_end = _behind(file, size, place.end, summary) or damage_at_end
    if damage_at_end:
        found.damages.append(damage_at_end)
    found.damages += _missing(found, summary, stated.chunks.keys() - chunks)
    found.stated_counts = stated.message_counts
    if index.chunks:
        found.message_counts = index.message_counts
    return found


def _behind(file: BinaryIO, size: int, data_end: int, summary: _Summary) -> str:
    """Describe the ignored bytes after the data section; return an empty text if there are none."""
    position = data_end
    while (place := _record_at(file, size, position)) is not None:
        position = place.end
        end = position + len(MAGIC)
        if place.opcode == Opcode.FOOTER and end < size:
            return (
                f"it ends at byte {end}, and the {size - end} bytes after that, perhaps another log, "
                "are left out"
            )
    if summary.start is None:
        return ""
    return (
        f"its data end at byte {data_end} and its summary begins at byte {summary.start}: the "
        "bytes between are left out"
    )


def _missing(found: Container, summary: _Summary, chunks: Iterable[int]) -> Iterator[str]:
    """Yield sentences on differences between the summary and the data section (`chunks`, metadata)."""
    for offset in sorted(chunks):
        yield f"there is no chunk at byte {offset}, although its index lists one"
    for entry in summary.records:
        if isinstance(entry, records.MetadataIndex) and entry.name not in found.metadata:
            yield f"its metadata record '{entry.name}' is missing"
    held = {key for region in found.regions for key in region.channel_ids or ()}
    for key in sorted(held - found.channels.keys()):
        count = f"{found.message_counts[key]} " if found.message_counts[key] else ""
        yield f"{count}messages of channel {key}, which it does not declare, are left out"


def _summary(file: BinaryIO, size: int) -> _Summary:
    """Read the summary; it is empty if the file has none. Raises Damaged."""
    file.seek(max(size - _FOOTER.size, 0))
    footer = file.read(_FOOTER.size)
    if len(footer) < _FOOTER.size:
        raise Damaged("its footer is missing")
    opcode, length, start, offset_start, checksum, magic = _FOOTER.unpack(footer)
    if (opcode, length, magic) != (Opcode.FOOTER, 20, MAGIC):
        raise Damaged("its footer is missing")
    start = start or offset_start or size - _FOOTER.size
    if not len(MAGIC) <= start <= size - _FOOTER.size:
        raise Damaged("its footer is damaged")
    summary = read_bytes(file, start, size - _FOOTER.size - start)
    if checksum not in (0, zlib.crc32(footer[:_FOOTER_CHECKED_BYTES], zlib.crc32(summary))):
        raise Damaged("its summary is damaged (the checksum is wrong)")
    return _Summary(list(read_records(summary)), start)


def _index(summary: Sequence[Any]) -> _Index:
    """Read the index from a summary; it is empty if a part is missing, so that every chunk is opened."""
    by_kind: dict[type, list[Any]] = {}
    for record in summary:
        by_kind.setdefault(type(record), []).append(record)
    chunks = {entry.chunk_start_offset: entry for entry in by_kind.get(records.ChunkIndex, [])}
    channels = by_kind.get(records.Channel, [])
    schema_ids = {0, *(schema.id for schema in by_kind.get(records.Schema, []))}
    for statistics in by_kind.get(records.Statistics, []):
        counts = Counter(statistics.channel_message_counts)
        stated = (statistics.chunk_count, statistics.channel_count, statistics.message_count)
        if (
            stated == (len(chunks), len(channels), counts.total())
            and counts.keys() <= {channel.id for channel in channels}
            and schema_ids.issuperset(channel.schema_id for channel in channels)
        ):
            return _Index(chunks, counts)
    return _Index({}, Counter())


def _data_section(file: BinaryIO, size: int, summary: _Summary) -> Iterator[_Place]:
    """Yield every complete record of the data section, and the bytes lost between records."""
    known = _stated_places(summary)
    run = position = len(MAGIC)
    kind = Opcode.SCHEMA
    while (place := _next_place(file, size, position, known)) is not None:
        is_loose = place.opcode in _LOOSE
        if run < position and (not is_loose or place.end - run > _LOOSE_BYTES):
            yield _Place(kind, run, position - run)
            run, kind = position, Opcode.SCHEMA
        position = place.end
        if not is_loose:
            yield place
            run = position
        elif place.opcode == Opcode.MESSAGE:
            kind = Opcode.MESSAGE
        if place.opcode == Opcode.DATA_END:
            return
    if run < position:
        yield _Place(kind, run, position - run)


def _next_place(file: BinaryIO, size: int, position: int, known: Sequence[_Place]) -> _Place | None:
    """Return the record at `position`, or the bytes lost until the next known one; None at the end.

    A record that extends beyond the beginning of another one is not complete.
    """
    place = _record_at(file, size, position)
    end = place.end if place else size
    for number in range(bisect_right(known, position, key=attrgetter("offset")), len(known)):
        if known[number].offset >= end:
            break
        if _record_at(file, size, known[number].offset) == known[number]:
            return _Place(_LOST, position, known[number].offset - position)
    return place


def _record_at(file: BinaryIO, size: int, position: int) -> _Place | None:
    """Read the record at `position`; None if it is not complete."""
    if position + RECORD_HEAD.size > size:
        return None
    opcode, length = RECORD_HEAD.unpack(read_bytes(file, position, RECORD_HEAD.size))
    place = _Place(opcode, position, RECORD_HEAD.size + length)
    return None if opcode == _LOST or place.end > size else place


def _stated_places(summary: _Summary) -> list[_Place]:
    """List the records of the data section whose position a summary states."""
    places = []
    for record in summary.records:
        if isinstance(record, records.ChunkIndex):
            places.append(_Place(Opcode.CHUNK, record.chunk_start_offset, record.chunk_length))
        elif isinstance(record, records.MetadataIndex):
            places.append(_Place(Opcode.METADATA, record.offset, record.length))
        elif isinstance(record, records.AttachmentIndex):
            places.append(_Place(Opcode.ATTACHMENT, record.offset, record.length))
    if summary.start is not None:
        places.append(_Place(Opcode.DATA_END, summary.start - _DATA_END_BYTES, _DATA_END_BYTES))
    return sorted(places, key=attrgetter("offset"))


def _note(found: Container, file: BinaryIO, place: _Place, index: _Index) -> None:
    """Add the contents of one record or run of the data section. Raises Damaged."""
    if place.opcode == _LOST:
        raise Damaged(f"its bytes {place.offset} to {place.end} are not a complete record")
    entry = index.chunk(place)
    if entry is not None:
        span = Span(entry.message_start_time, entry.message_end_time)
        channel_ids = frozenset(entry.message_index_offsets) or None
        found.regions.append(Region(place.offset, place.length, {"log_time": span}, channel_ids))
    elif place.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
        contents = open_region(read_bytes(file, place.offset, place.length), place.offset)
        _declare(found, contents.declarations)
        if contents.messages:
            region = Region(place.offset, place.length, contents.spans, frozenset(contents.messages))
            found.regions.append(region)
            found.message_counts.update({key: len(each) for key, each in contents.messages.items()})
    elif place.opcode == Opcode.SCHEMA:
        _declare(found, read_records(read_bytes(file, place.offset, place.length)))
    elif place.opcode == Opcode.ATTACHMENT:
        found.attachments.append(_attachment_name(file, place))
    elif place.opcode in (Opcode.METADATA, Opcode.DATA_END):
        for record in read_records(read_bytes(file, place.offset, place.length)):
            if isinstance(record, records.Metadata):
                found.metadata[record.name] = unseal(record.name, record.metadata)
            elif not index.chunks and record.data_section_crc not in (0, _checksum(file, place.offset)):
                raise Damaged("the checksum of its data section is wrong")


def _attachment_name(file: BinaryIO, place: _Place) -> str:
    """Read the name of an attachment, without its data, which may be large. Raises Damaged."""
    start = RECORD_HEAD.size + _ATTACHMENT_HEAD.size
    if place.length >= start:
        head = read_bytes(file, place.offset + RECORD_HEAD.size, _ATTACHMENT_HEAD.size)
        *_, length = _ATTACHMENT_HEAD.unpack(head)
        if start + length <= place.length:
            return read_bytes(file, place.offset + start, length).decode(errors="replace")
    raise Damaged(f"the attachment at byte {place.offset} is damaged (its name is incomplete)")


def _declare(found: Container, declarations: Iterable[Any]) -> None:
    """Add schemas and channels. Raises Damaged if one id has two meanings."""
    known: dict[type, dict] = {records.Schema: found.schemas, records.Channel: found.channels}
    for record in declarations:
        kind = type(record)
        if kind in known and known[kind].setdefault(record.id, record) != record:
            raise Damaged(f"it declares {kind.__name__.lower()} {record.id} twice, in different ways")


def _checksum(file: BinaryIO, end: int) -> int:
    """Compute the checksum of the file up to `end`."""
    file.seek(0)
    checksum = 0
    for begin in range(0, end, _LOOSE_BYTES):
        checksum = zlib.crc32(file.read(min(_LOOSE_BYTES, end - begin)), checksum)
    return checksum
