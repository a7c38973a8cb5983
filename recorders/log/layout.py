"""The one byte layout that all messages of a stream share, as a NumPy type.

A message record of MCAP is opcode, length, channel, sequence, two clocks and the payload; the payload
is protobuf whose fields all have a fixed width. So a structured array is the bytes of a chunk, and the
bytes of a chunk are columns. Nothing is believed unseen: `parse` compares every constant byte.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from recorders.log.schemas import Field, Schema

RECORD_HEAD = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time_ns", "<u8"),
    ("publish_time_ns", "<u8"),
]
HEAD_BYTES = np.dtype(RECORD_HEAD).itemsize
# An MCAP record's length does not count its own opcode and length.
UNCOUNTED_BYTES = 9

_WIRE_TYPES = {"time_ns": 1, "identifier": 5, "real": 1, "vector": 2}


@dataclass(frozen=True)
class Layout:
    """The byte layout of one schema with given vector widths."""

    schema: Schema
    dtype: np.dtype
    prefixes: Mapping[str, NDArray[np.uint8]]

    @property
    def payload_length(self) -> int:
        """The length that every record of this layout states."""
        return self.dtype.itemsize - UNCOUNTED_BYTES

    def build(
        self,
        channel_id: int,
        first_sequence: int,
        log_time_ns: NDArray[np.int64],
        publish_time_ns: NDArray[np.int64],
        columns: Mapping[str, NDArray],
    ) -> NDArray[np.void]:
        """Message records as a structured array (n,)."""
        records = np.empty(len(log_time_ns), self.dtype)
        records["opcode"] = Opcode.MESSAGE
        records["length"] = self.payload_length
        records["channel_id"] = channel_id
        records["sequence"] = np.arange(first_sequence, first_sequence + len(records))
        records["log_time_ns"] = log_time_ns
        records["publish_time_ns"] = publish_time_ns
        for name, prefix in self.prefixes.items():
            records[_prefix_name(name)] = prefix
            records[name] = columns[name]
        return records

    def columns(self, records: NDArray[np.void]) -> dict[str, NDArray]:
        """The schema's columns, copied out of records; an empty vector has shape (n, 0)."""
        return {
            field.name: np.ascontiguousarray(records[field.name])
            if field.name in self.prefixes
            else np.empty((len(records), 0))
            for field in self.schema
        }

    def parse(
        self, chunk: NDArray[np.uint8], offsets: NDArray[np.int64], channel_id: int
    ) -> NDArray[np.void] | None:
        """Message records at `offsets` of an uncompressed chunk, or None where a byte is not as expected."""
        size = self.dtype.itemsize
        if len(offsets) == 0:
            return np.empty(0, self.dtype)
        if offsets.min() < 0 or offsets.max() + size > len(chunk):
            return None
        if len(offsets) * size == offsets[-1] + size - offsets[0] and np.all(np.diff(offsets) == size):
            records = chunk[offsets[0] : offsets[-1] + size].view(self.dtype)
        else:
            records = windows(chunk, size)[offsets].view(self.dtype)
        head_is_ours = (
            np.all(records["opcode"] == Opcode.MESSAGE)
            and np.all(records["length"] == self.payload_length)
            and np.all(records["channel_id"] == channel_id)
        )
        if not head_is_ours:
            return None
        for name, prefix in self.prefixes.items():
            if not np.all(records[_prefix_name(name)] == prefix):
                return None
        return records


def windows(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """Every run of `size` bytes of `data` as one opaque item, without a copy: gathers and scatters."""
    return np.ndarray(
        (len(data) - size + 1,), dtype=np.dtype((np.void, size)), buffer=data.data, strides=(1,)
    )


def layout_of(schema: Schema, widths: Mapping[str, int]) -> Layout:
    """The layout of `schema` when its vectors have these widths."""
    return _layout(schema, tuple(widths.get(field.name, 0) for field in schema))


@lru_cache(maxsize=256)
def _layout(schema: Schema, widths: tuple[int, ...]) -> Layout:
    members: list[tuple] = list(RECORD_HEAD)
    prefixes: dict[str, NDArray[np.uint8]] = {}
    for number, (field, width) in enumerate(zip(schema, widths, strict=True), start=1):
        if field.kind == "vector" and width == 0:
            continue  # an empty vector is absent from the wire, as proto3 has it
        prefix = np.frombuffer(_prefix(number, field, width), np.uint8)
        prefixes[field.name] = prefix
        members.append((_prefix_name(field.name), "u1", prefix.shape))
        members.append((field.name, field.dtype, (width,) if field.kind == "vector" else ()))
    return Layout(schema, np.dtype(members), prefixes)


def _prefix(number: int, field: Field, width: int) -> bytes:
    """The tag, and for a vector the length in bytes, that stand before a field's value."""
    tag = _varint(number << 3 | _WIRE_TYPES[field.kind])
    return tag + _varint(width * field.dtype.itemsize) if field.kind == "vector" else tag


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _prefix_name(name: str) -> str:
    return f"before {name}"
