"""Layouts of ULog's messages: format definitions, flattened to NumPy's types."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

TYPES = {
    "int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "<i1", "char": "<i1",
}  # fmt: skip
# A message's size has 16 bits, and two of its bytes are its number.
_MOST_BYTES = 0xFFFF - 2


class Damaged(Exception):
    """An error for a definition that cannot be used; the text gives the reason."""


class FormatField(NamedTuple):
    """One field of a format: its type, the length of its array (0: no array), and its name."""

    type: str
    length: int
    name: str


class Layout(NamedTuple):
    """The layout of a topic's messages in a file.

    `dtype` has a field for every number, such as `q[0]` or `esc[1].rpm`. It excludes padding at the end,
    which a message may lack: a message has between `dtype.itemsize` and `most_bytes` bytes. `stamp` is
    the position of its stamp.
    """

    dtype: np.dtype
    most_bytes: int
    stamp: int


def parsed(text: str) -> tuple[str, list[FormatField]]:
    """Parse the name and fields of a format; raise Damaged if this fails."""
    name, colon, rest = text.partition(":")
    if not colon or not name:
        raise Damaged("a format has no name")
    return name, [_field(name, each) for each in rest.split(";") if each]


def _field(of: str, text: str) -> FormatField:
    stated, _, name = text.partition(" ")
    kind, bracket, count = stated.partition("[")
    if not name or not kind or (bracket and not (count.endswith("]") and count[:-1].isdecimal())):
        raise Damaged(f"format {of} has a field that cannot be read")
    if len(count) > len("65535]"):
        raise Damaged(f"format {of} has an array of {count[:-1]}")
    return FormatField(kind, int(count[:-1]) if bracket else 0, name)


def layout_of(name: str, formats: Mapping[str, list[FormatField]]) -> Layout:
    """Determine a topic's layout; raise Damaged if its format is unknown, too long or recursive."""
    entries: list[tuple[str, str]] = []
    size = 0
    for entry, kind in _flat(name, formats, ()):
        entries.append((entry, TYPES[kind]))
        size += np.dtype(TYPES[kind]).itemsize
        if size > _MOST_BYTES:
            raise Damaged(f"format {name} is longer than a message can be")
    while entries and entries[-1][0].startswith("_padding"):
        entries.pop()
    try:
        dtype = np.dtype(entries)
    except ValueError:
        raise Damaged(f"format {name} has a field twice") from None
    if "timestamp" not in (dtype.names or ()) or dtype["timestamp"] != np.dtype("<u8"):
        raise Damaged(f"format {name} has no stamp")
    assert dtype.fields is not None
    return Layout(dtype, size, dtype.fields["timestamp"][1])


def _flat(
    name: str, formats: Mapping[str, list[FormatField]], within: tuple[str, ...], prefix: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield the name and type of every number in a format."""
    if name in within:
        raise Damaged(f"format {name} refers to itself")
    if name not in formats:
        raise Damaged(f"format {name} is not defined")
    if not formats[name]:
        raise Damaged(f"format {name} has no fields")  # so that nesting ends
    for field in formats[name]:
        named = [f"{field.name}[{index}]" for index in range(field.length)] or [field.name]
        for each in named:
            if field.type in TYPES:
                yield prefix + each, field.type
            else:
                yield from _flat(field.type, formats, (*within, name), f"{prefix}{each}.")
