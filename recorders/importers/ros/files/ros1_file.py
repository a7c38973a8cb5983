"""Reader of the bags of ROS 1 (.bag), record by record; it uses the index but does not need it.

Source: wiki.ros.org/Bags/Format/2.0.
"""

import bz2
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.files.raw import Batch, Connection
from fuselog.recorders.log.container.ahead import ahead
from fuselog.recorders.log.loops import kernel

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7
_LENGTH = struct.Struct("<I")
_COUNT = np.dtype([("connection", "<u4"), ("messages", "<u4")])
_DECOMPRESS: dict[bytes, Callable[[bytes], bytes]] = {
    b"none": bytes,
    b"bz2": bz2.decompress,
    b"lz4": lz4.frame.decompress,
}


class _Record(NamedTuple):
    """A record of the file: its header, and the position of its data."""

    header: dict[str, bytes]
    begin: int
    length: int

    @property
    def kind(self) -> int:
        """Return the kind of record; 0 if it is not stated."""
        return int.from_bytes(self.header.get("op", b""), "little")


class _Scanned(NamedTuple):
    """The records of a chunk (n,): kinds, connections, stamps, and positions of headers and data.

    `end` is the position at which the walk stopped: the chunk's length, or the first incomplete record.
    """

    kinds: NDArray[np.int64]
    connections: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    headers: NDArray[np.int64]
    begins: NDArray[np.int64]
    lengths: NDArray[np.int64]
    end: int


class Ros1File:
    """A .bag file; see `BagFile`. Raises BadInput if the file is not a .bag file, or cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.others: list[str] = []
        self.losses: list[str] = []
        self._chunks: list[_Record] = []
        self._stated: dict[int, tuple[str, str, MessageDefinition]] = {}
        self._counts: Counter[int] = Counter()
        try:
            with path.open("rb") as file:
                self._index(file)
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
        self._by_id = {
            number: Connection(topic, name, "ros1", definition, self._counts[number])
            for number, (topic, name, definition) in self._stated.items()
        }
        self.connections = list(self._by_id.values())

    def _index(self, file: BinaryIO) -> None:
        """Find the chunks and connections; if the list after the chunks is missing, open all chunks."""
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BadInput(
                f"{self.path}: is not a bag of ROS 1 in format 2.0; convert an older one with rosbag fix"
            )
        size = file.seek(0, 2)
        position = len(_MAGIC)
        has_index = False
        while position < size:
            record = _record_at(file, position, size)
            if record is None:
                self.losses.append(
                    f"{self.path}: it was cut off: its last {size - position} bytes are not a complete "
                    "record"
                )
                break
            position = record.begin + record.length
            if record.kind == _CHUNK:
                self._chunks.append(record)
                if position > size:
                    missing = f"the last chunk lacks {position - size} of {record.length} bytes"
                    self.losses.append(f"{self.path}: it was cut off: {missing}")
            elif record.kind == _CONNECTION:
                self._declare(record.header, _read(file, record))
                has_index = True
            elif record.kind == _CHUNK_INFO:
                for number, count in np.frombuffer(_read(file, record), _COUNT).tolist():
                    self._counts[number] += count
        if self._chunks and (self.losses or not has_index):  # a truncated index is incomplete
            if not self.losses:
                self.losses.append(
                    f"{self.path}: was not closed, so it has no index; it is read without one"
                )
            self._counts.clear()
            for record in self._chunks:
                self._search(_read(file, record), record)

    def _search(self, raw: bytes, record: _Record) -> None:
        """Find the connections and the counts of a chunk by opening it."""
        opened = _opened((record, raw))
        if isinstance(opened, str):
            return
        data, found = opened
        for row in np.flatnonzero(found.kinds == _CONNECTION).tolist():
            header = _fields(data[found.headers[row] : found.begins[row] - 4].tobytes())
            begin = found.begins[row]
            self._declare(header, data[begin : begin + found.lengths[row]].tobytes())
        self._counts.update(found.connections[found.kinds == _MESSAGE].tolist())

    def _declare(self, header: dict[str, bytes], data: bytes) -> None:
        fields = _fields(data)
        number = int.from_bytes(header.get("conn", b""), "little")
        definition = fields.get("message_definition", b"").decode(errors="replace")
        self._stated[number] = (
            "/" + header.get("topic", b"").decode(errors="replace").strip("/"),
            normalize_msgtype(fields.get("type", b"").decode(errors="replace")),
            MessageDefinition(MessageDefinitionFormat.MSG, definition),
        )

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, a chunk of the file at a time."""
        chosen = {number: each for number, each in self._by_id.items() if wanted(each)}
        with self.path.open("rb") as file:
            reads = ((record, _read(file, record)) for record in self._chunks)
            for record, opened in zip(self._chunks, ahead(_opened, reads), strict=True):
                place = f"{self.path}: the chunk at byte {record.begin}"
                if isinstance(opened, str):
                    self.losses.append(f"{place} is lost ({opened})")
                    continue
                data, found = opened
                if found.end < len(data):
                    lost = len(data) - found.end
                    self.losses.append(f"{place}: its last {lost} bytes are not a complete message")
                is_known = np.isin(found.connections, list(self._by_id))
                strange = (found.kinds != _CONNECTION) & ~((found.kinds == _MESSAGE) & is_known)
                if strange.any():
                    count = int(strange.sum())
                    self.losses.append(
                        f"{place}: {count} records are not messages of its topics, and are lost"
                    )
                for number, connection in chosen.items():
                    rows = (found.kinds == _MESSAGE) & (found.connections == number)
                    if rows.any():
                        yield Batch(
                            connection,
                            data,
                            found.begins[rows],
                            found.lengths[rows],
                            found.time_ns[rows],
                        )


def _record_at(file: BinaryIO, position: int, size: int) -> _Record | None:
    """Read the record at a position; return None if it is truncated, unless only a chunk's data are."""
    file.seek(position)
    head = file.read(_LENGTH.size)
    length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else size
    if position + 2 * _LENGTH.size + length > size:
        return None
    header = _fields(file.read(length))
    (data_length,) = _LENGTH.unpack(file.read(_LENGTH.size))
    record = _Record(header, position + 2 * _LENGTH.size + length, data_length)
    return record if record.begin + data_length <= size or record.kind == _CHUNK else None


def _read(file: BinaryIO, record: _Record) -> bytes:
    file.seek(record.begin)
    return file.read(record.length)


def _fields(raw: bytes) -> dict[str, bytes]:
    """Read the complete fields of a header by name."""
    found, position = {}, 0
    while position + _LENGTH.size <= len(raw):
        end = position + _LENGTH.size + _LENGTH.unpack_from(raw, position)[0]
        name, equals, value = raw[position + _LENGTH.size : end].partition(b"=")
        if end > len(raw) or not equals:
            break
        found[name.decode(errors="replace")] = value
        position = end
    return found


def _opened(read: tuple[_Record, bytes]) -> tuple[NDArray[np.uint8], _Scanned] | str:
    """Open a chunk's records; return the reason if they cannot be read."""
    record, raw = read
    compression = record.header.get("compression", b"")
    if compression not in _DECOMPRESS:
        return f"its compression {compression.decode(errors='replace')} is not one of none, bz2 and lz4"
    try:
        data = np.frombuffer(_DECOMPRESS[compression](raw), np.uint8)
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        return str(error)
    found, ends = np.zeros((6, len(data) // 8 + 1), np.int64), np.empty(1, np.int64)
    found[1] = -1
    count = kernel(_scan)(data, *found, ends)
    return data, _Scanned._make([*found[:, :count], *ends.tolist()])


def _number(data: NDArray[np.uint8], place: int) -> int:
    """Read the little-endian number in the four bytes at a position."""
    part, number = data[place : place + 4], 0
    for k in (3, 2, 1, 0):
        number = number << 8 | int(part[k])
    return number


def _scan(
    data: NDArray[np.uint8],
    kinds: NDArray[np.int64],
    connections: NDArray[np.int64],
    time_ns: NDArray[np.int64],
    headers: NDArray[np.int64],
    begins: NDArray[np.int64],
    lengths: NDArray[np.int64],
    ends: NDArray[np.int64],
) -> int:
    """Fill in the kinds and positions of the records of a chunk; count them."""
    size, count, position = len(data), 0, 0
    while position + 4 <= size:
        begin = position + 4
        end = begin + _number(data, position)
        if end + 4 > size:
            break
        length = _number(data, end)
        if end + 4 + length > size:
            break
        headers[count], begins[count], lengths[count] = begin, end + 4, length
        while begin + 4 <= end:
            value_end = begin + 4 + _number(data, begin)
            if value_end > end:
                break
            name = data[begin + 4 : value_end]
            if len(name) == 4 and name[0] == 111 and name[1] == 112 and name[2] == 61:  # op=
                kinds[count] = name[3]
            elif len(name) == 9 and name[0] == 99 and name[4] == 61:  # conn=
                connections[count] = _number(name, 5)
            elif len(name) == 13 and name[0] == 116 and name[4] == 61:  # time=
                time_ns[count] = _number(name, 5) * 1_000_000_000 + _number(name, 9)
            begin = value_end
        count += 1
        position = end + 4 + length
    ends[0] = position
    return count
