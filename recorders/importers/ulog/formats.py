"""Lays out ULog's messages: format definitions, flattened to NumPy's types."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

TYPES = {
    "int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "<i1", "char": "<i1",
}  # fmt: skip
# A message's size is 16 bits, two bytes of which are its number.
_MOST_BYTES = 0xFFFF - 2


class Damaged(Exception):
    """Says why a definition cannot be used."""


class FormatField(NamedTuple):
    """Describes one field of a format: its type, how many of it (0: no array), and its name."""

    type: str
    length: int
    name: str


class Layout(NamedTuple):
    """Describes how the messages of a topic lie in a file.

    `dtype` has a field for every number, as `q[0]` or `esc[1].rpm`; padding at its end, which a message
    may lack, is not in it: a message has between `dtype.itemsize` and `most_bytes` bytes. `stamp` is
    where its stamp begins.
    """

    dtype: np.dtype
    most_bytes: int
    stamp: int


def parsed(text: str) -> tuple[str, list[FormatField]]:
    """Return the name and the fields of a format; raises Damaged."""
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
    """Return a topic's layout; raises Damaged where its format is unknown, too long or within itself."""
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
    """Yield every number of a format, by name, and its type."""
    if name in within:
        raise Damaged(f"format {name} refers to itself")
    if name not in formats:
        raise Damaged(f"format {name} is not defined")
    if not formats[name]:
        raise Damaged(f"format {name} has no fields")  # so that what is nested has an end
    for field in formats[name]:
        named = [f"{field.name}[{index}]" for index in range(field.length)] or [field.name]
        for each in named:
            if field.type in TYPES:
                yield prefix + each, field.type
            else:
                yield from _flat(field.type, formats, (*within, name), f"{prefix}{each}.")
