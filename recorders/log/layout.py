"""The byte layout that all messages of a stream share, as a NumPy type.

A message record of MCAP is opcode, length, channel, sequence, two clocks and the payload; the payload is
protobuf, and all its fields have a fixed width. So the bytes of a chunk can be viewed as a structured
array, and columns can be written as bytes. Nothing is assumed: `parse` compares every constant byte.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from fuselog.recorders.log.loops import HEAD_BYTES, Pattern, agree, pattern_of
from fuselog.recorders.log.schemas import Field, Schema
from fuselog.recorders.log.streams import Stream

# No protobuf field can have a name with a space.
RECORD_HEAD = np.dtype(
    [
        ("mcap opcode", "u1"),
        ("mcap length", "<u8"),
        ("mcap channel_id", "<u2"),
        ("mcap sequence", "<u4"),
        ("mcap log_time", "<i8"),
        ("mcap publish_time", "<i8"),
    ]
)
_WIRE_TYPES = {"time_ns": 1, "identifier": 5, "real": 1, "vector": 2}


@dataclass(frozen=True)
class Layout:
    """The byte layout of one schema with given vector widths, with a mask of its constant bytes.

    An empty vector is absent from the message, as in proto3, and so from `dtype`.
    """

    dtype: np.dtype
    template: NDArray[np.uint8]
    pattern: Pattern

    def build(self, stream: Stream, channel_id: int, first_sequence: int) -> NDArray[np.void]:
        """Make the stream's message records, as a structured array (n,)."""
        rows = np.repeat(self.template.view(_opaque(self.dtype.itemsize)), len(stream))
        records = rows.view(self.dtype)
        records["mcap channel_id"] = channel_id
        records["mcap sequence"] = np.arange(first_sequence, first_sequence + len(records))
        records["mcap log_time"] = stream.log_time_ns
        records["mcap publish_time"] = stream.publish_time_ns
        for name, column in stream.columns.items():
            if name in (self.dtype.names or ()):
                records[name] = column
        return records

    def parse(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> NDArray[np.void] | None:
        """Read the message records (n,) at `offsets` of a chunk; None if one has another layout."""
        if not agree(data, offsets, self.pattern):
            return None
        return windows(data, self.dtype.itemsize)[offsets].view(self.dtype)


def columns_of(schema: Schema, records: NDArray[np.void]) -> dict[str, NDArray]:
    """Copy the schema's columns out of records, in which numbers are not aligned as kernels need them.

    Args:
        schema: schema of the records.
        records: (n,), as returned by `Layout.parse`.

    Returns:
        Columns by field, (n,) or (n, width); an empty vector has shape (n, 0).
    """
    return {
        field.name: records[field.name].copy()
        if field.name in (records.dtype.names or ())
        else np.empty((len(records), 0))
        for field in schema
    }


def windows(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """View every run of `size` bytes as one opaque item, without a copy, to gather and scatter them.

    Args:
        data: (n,), the bytes.
        size: number of bytes in an item.

    Returns:
        (n - size + 1,), the items that begin at each byte.
    """
    return np.ndarray((len(data) - size + 1,), _opaque(size), data.data, strides=(1,))


def _opaque(size: int) -> np.dtype:
    return np.dtype((np.void, size))


def layout_of(schema: Schema, widths: Mapping[str, int]) -> Layout:
    """Return the layout of `schema` for vectors of these widths."""
    return _layout(schema, tuple(widths.get(field.name, 0) for field in schema))


@lru_cache(maxsize=256)
def _layout(schema: Schema, widths: tuple[int, ...]) -> Layout:
    members: list[tuple] = list(RECORD_HEAD.descr)
    constants: dict[str, bytes | int] = {"mcap opcode": Opcode.MESSAGE}
    for number, (field, width) in enumerate(zip(schema, widths, strict=True), start=1):
        if field.kind == "vector" and width == 0:
            continue
        prefix = _prefix(number, field, width)
        constants[f"before {field.name}"] = prefix
        members.append((f"before {field.name}", f"V{len(prefix)}"))
        members.append((field.name, field.dtype, (width,) if field.kind == "vector" else ()))
    dtype = np.dtype(members)
    # An MCAP record's length does not count its own opcode and length.
    constants["mcap length"] = dtype.itemsize - HEAD_BYTES
    template, is_fixed = np.zeros(1, dtype), np.zeros(1, dtype)
    for name, value in constants.items():
        template[name] = value
        is_fixed[name] = b"\xff" * len(value) if isinstance(value, bytes) else np.iinfo(dtype[name]).max
    template_bytes = template.view(np.uint8)
    return Layout(dtype, template_bytes, pattern_of(template_bytes, is_fixed.view(np.uint8)))


def _prefix(number: int, field: Field, width: int) -> bytes:
    """Encode the tag before a field's value, followed by the length in bytes for a vector."""
    tag = _varint(number << 3 | _WIRE_TYPES[field.kind])
    return tag + _varint(width * field.dtype.itemsize) if field.kind == "vector" else tag


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
