"""Decoding of ROS messages into columns, for any message type.

A message without strings and sequences has one byte layout. Otherwise, the layout depends only on the
lengths of strings and sequences, in which messages of one topic rarely differ. So the layout is
determined once, by walking along one message and its definition; all messages with the same lengths are
then read together. Sources: wiki.ros.org/msg (ROS 1); OMG DDS-XTypes 1.3, section 7.4.1, plain CDR of
version 1 (ROS 2).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from fuselog.recorders.log.layout import windows

Encoding = Literal["cdr", "ros1"]
# The constants of each message type, and the names and types of its fields.
Definitions = Mapping[str, tuple[Any, Sequence[tuple[str, Any]]]]

# Byte order and options in front of a serialised message.
_ENCAPSULATION_BYTES = 4
_BYTE_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_NUMPY_TYPES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_IDL_BORDER = "=" * 80 + "\n"


class Undecodable(ValueError):
    """An error for a message or a definition that cannot be decoded; the text gives the reason."""


def definitions_of(name: str, stated: MessageDefinition, distribution: str) -> Definitions:
    """Return the type `name` and the types in it, from the bag or else from a distribution of ROS.

    Raises Undecodable if neither has the type.
    """
    try:
        if stated.format is MessageDefinitionFormat.MSG:
            return {**_BASE, **get_types_from_msg(stated.data, name)}
        if stated.format is MessageDefinitionFormat.IDL:
            found = dict(_BASE)
            for part in stated.data.split(_IDL_BORDER):
                text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                found.update(get_types_from_idl(text) if text.strip() else {})
            return found
    except TypesysError as error:
        raise Undecodable(f"its definition cannot be read ({error})") from error
    known = get_typestore(Stores(distribution)).fielddefs
    if name not in known:
        raise Undecodable(f"neither the bag nor {distribution} defines it")
    return known


_BASE = get_typestore(Stores.EMPTY).fielddefs


class _Number(NamedTuple):
    """The position of a number, or of an array of `number` numbers."""

    offset: int
    dtype: np.dtype
    number: int | None


class _Text(NamedTuple):
    """The position of a text, without the zero at its end."""

    offset: int
    length: int


@dataclass
class Layout:
    """The positions of all fields in messages whose texts and sequences have the same lengths.

    Fields are named by their paths: `pose.pose.position.x`, `transforms.0.child_frame_id`. `fixed` has
    the bytes of all lengths, by position; they are the same in every message of the layout.
    """

    numbers: dict[str, _Number] = field(default_factory=dict)
    texts: dict[str, _Text] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    fixed: dict[int, int] = field(default_factory=dict)

    def fits(self, raw: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Test which of the messages (n, size) have this layout."""
        return (raw[:, list(self.fixed)] == np.array(list(self.fixed.values()), np.uint8)).all(axis=1)


@dataclass(frozen=True)
class Messages:
    """Messages (n,) of one layout: their bytes (n, size), and their rows in the topic."""

    layout: Layout
    raw: NDArray[np.uint8]
    rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rows)

    def numbers(self, path: str) -> NDArray:
        """Read a field (n,), or an array (n, count); raise KeyError if there is no such field."""
        offset, dtype, count = self.layout.numbers[path]
        part = self.raw[:, offset : offset + dtype.itemsize * (1 if count is None else count)]
        if count == 0:
            return np.empty((len(self), 0), dtype)
        column = part.view(dtype).astype(dtype.newbyteorder("="))
        return column[:, 0] if count is None else column

    def text(self, path: str) -> NDArray[np.bytes_]:
        """Read a text (n,) as bytes; raise KeyError if there is no such field."""
        offset, length = self.layout.texts[path]
        if not length:
            return np.zeros(len(self), "S1")
        return np.ascontiguousarray(self.raw[:, offset : offset + length]).view(f"S{length}")[:, 0]


def by_size(
    data: NDArray[np.uint8], begins: NDArray[np.int64], lengths: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Yield the bytes of messages, grouped by size.

    Args:
        data: bytes of all messages.
        begins: (n,), position in `data` where each message begins.
        lengths: (n,), length of each message in bytes.

    Yields:
        Indices (k,) of the messages with one size, and their bytes (k, size).
    """
    for size in np.unique(lengths).tolist():
        which = np.flatnonzero(lengths == size)
        if size:
            yield which, windows(data, size)[begins[which]].view(np.uint8).reshape(-1, size)
        else:
            yield which, np.empty((len(which), 0), np.uint8)


class MessageType:
    """A reader of messages of one type and encoding, which keeps the layouts found so far."""

    _MOST_LAYOUTS = 63  # for each size

    def __init__(self, name: str, definitions: Definitions, encoding: Encoding) -> None:
        self.name = name
        self._definitions = definitions
        self._encoding: Encoding = encoding
        self._layouts: dict[int, list[Layout]] = {}

    def fields(self) -> dict[str, str]:
        """Return the paths and types of all fields with a single number or a fixed array."""
        return dict(self._flat("", (Nodetype.NAME, self.name)))

    def read(self, raw: NDArray[np.uint8], rows: NDArray[np.int64]) -> Iterator[Messages | Undecodable]:
        """Yield messages of one size (n, size), with rows (n,), by layout; yield errors for bad ones."""
        while len(rows):
            try:
                layout, same = self._next(raw)
            except Undecodable as error:
                yield error
                raw, rows = raw[1:], rows[1:]
                continue
            if same.all():
                yield Messages(layout, raw, rows)
                return
            yield Messages(layout, raw[same], rows[same])
            raw, rows = raw[~same], rows[~same]

    def _next(self, raw: NDArray[np.uint8]) -> tuple[Layout, NDArray[np.bool_]]:
        """Find the layout of the first message (n, size), and test which messages (n,) have it."""
        known = self._layouts.setdefault(raw.shape[1], [])
        for layout in known:
            if layout.fits(raw[:1])[0]:
                return layout, layout.fits(raw)
        layout = _Walk(self._definitions, raw[0].tobytes(), self._encoding).layout(self.name)
        del known[self._MOST_LAYOUTS :]
        known.insert(0, layout)
        return layout, layout.fits(raw)

    def _flat(self, path: str, description: Any) -> Iterator[tuple[str, str]]:
        kind, of = description
        if kind is Nodetype.NAME:
            for name, inner in self._definitions[of][1]:
                yield from self._flat(f"{path}.{name}" if path else name, inner)
        elif kind is Nodetype.BASE and of[0] in _NUMPY_TYPES:
            yield path, of[0]
        elif kind is Nodetype.ARRAY and of[0][0] is Nodetype.BASE and of[0][1][0] in _NUMPY_TYPES:
            yield path, f"{of[0][1][0]}[{of[1]}]"


class _Walk:
    """A walk along one message, field by field."""

    def __init__(self, definitions: Definitions, raw: bytes, encoding: Encoding) -> None:
        self._definitions, self._raw = definitions, raw
        self._is_cdr = encoding == "cdr"
        self._order = _BYTE_ORDERS.get(raw[:2], "") if self._is_cdr else "<"
        if not self._order or (self._is_cdr and len(raw) < _ENCAPSULATION_BYTES):
            raise Undecodable(f"its encapsulation is '{raw[:2].hex()}', not plain CDR")
        self._position = self._start = _ENCAPSULATION_BYTES if self._is_cdr else 0
        self._found = Layout()
        self._fix(0, 2 if self._is_cdr else 0)

    def layout(self, name: str) -> Layout:
        """Determine the layout; raise Undecodable if the message does not match its definition."""
        self._walk("", (Nodetype.NAME, name))
        behind = len(self._raw) - self._position
        if not 0 <= behind < (4 if self._is_cdr else 1):
            raise Undecodable(f"it has {behind} bytes more than its definition {name} describes")
        return self._found

    def _walk(self, path: str, description: Any) -> None:
        kind, of = description
        if kind is Nodetype.BASE:
            self._base(path, of[0], None)
        elif kind is Nodetype.NAME:
            if of not in self._definitions:
                raise Undecodable(f"{of} is not defined")
            for name, inner in self._definitions[of][1]:
                self._walk(f"{path}.{name}" if path else name, inner)
        else:
            inner, count = of
            count = count if kind is Nodetype.ARRAY else self._length()
            if inner[0] is Nodetype.BASE and inner[1][0] in _NUMPY_TYPES:
                self._base(path, inner[1][0], count)
                return
            if count > len(self._raw):
                raise Undecodable("a sequence in it is longer than the message")
            self._found.counts[path] = count
            for number in range(count):
                self._walk(f"{path}.{number}", inner)

    def _base(self, path: str, name: str, count: int | None) -> None:
        if name == "string":
            length = self._length()
            self._found.texts[path] = _Text(self._position, max(length - self._is_cdr, 0))
            self._step(length)
        elif name not in _NUMPY_TYPES:
            raise Undecodable(f"its field {path} has the type {name}, which fuselog cannot read")
        else:
            dtype = np.dtype(self._order + _NUMPY_TYPES[name])
            if count != 0:
                self._align(dtype.itemsize)
            self._found.numbers[path] = _Number(self._position, dtype, count)
            self._step(dtype.itemsize * (1 if count is None else count))

    def _length(self) -> int:
        """Read the length of a text or sequence, which is a part of the layout."""
        self._align(4)
        place = self._position
        self._step(4)
        self._fix(place, self._position)
        return int.from_bytes(self._raw[place : place + 4], "big" if self._order == ">" else "little")

    def _fix(self, begin: int, end: int) -> None:
        self._found.fixed.update(enumerate(self._raw[begin:end], start=begin))

    def _align(self, size: int) -> None:
        if self._is_cdr:
            self._position += -(self._position - self._start) % size

    def _step(self, size: int) -> None:
        self._position += size
        if self._position > len(self._raw):
            raise Undecodable("it is shorter than its definition says")
