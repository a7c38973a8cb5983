"""Reads messages of a cut-off sqlite3 bag from its pages: the tree that leads to them has gaps.

Source: sqlite.org/fileformat2.html, sections 1.5, 1.6 and 2.1.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_PAGE_SIZE, _RESERVED, _PAGES = slice(16, 18), 20, slice(28, 32)
_TABLE_LEAF = 13
_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}


def missing_bytes(path: Path) -> int:
    """Count the bytes that a database lacks of those that it states; 0 for what is no database."""
    with path.open("rb") as file:
        head = file.read(100)
    if not head.startswith(b"SQLite format 3\0"):
        return 0
    return max(int.from_bytes(head[_PAGES], "big") * _page_size(head) - path.stat().st_size, 0)


def whole_rows(path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield topic, stamp in ns and message of every row of `messages` that is whole."""
    with path.open("rb") as file:
        head = file.read(100)
        size = _page_size(head)
        usable = size - head[_RESERVED]
        for number in range(1, path.stat().st_size // size):
            file.seek(number * size)
            page = file.read(size)
            if page[0] != _TABLE_LEAF:
                continue
            for cell in range(int.from_bytes(page[3:5], "big")):
                try:
                    row = _row(_payload(file, page, 8 + 2 * cell, usable, size))
                except (IndexError, EOFError):
                    continue  # it goes on where the file does not
                if row is not None:
                    yield row


def _page_size(head: bytes) -> int:
    size = int.from_bytes(head[_PAGE_SIZE], "big")
    return 65536 if size == 1 else size


def _payload(file: BinaryIO, page: bytes, place: int, usable: int, size: int) -> bytes:
    """Read the bytes of a cell, also on further pages. Raises EOFError where these are missing."""
    place = int.from_bytes(page[place : place + 2], "big")
    length, place = _varint(page, place)
    _, place = _varint(page, place)
    most, least = usable - 35, (usable - 12) * 32 // 255 - 23
    local = length
    if length > most:
        local = least + (length - least) % (usable - 4)
        local = local if local <= most else least
    parts = [page[place : place + local]]
    rest, following = length - local, int.from_bytes(page[place + local : place + local + 4], "big")
    while rest > 0:
        file.seek((following - 1) * size if following else 0, 0 if following else 2)
        further = file.read(size)
        if len(further) < size:
            raise EOFError
        parts.append(further[4 : 4 + min(rest, usable - 4)])
        rest, following = rest - (usable - 4), int.from_bytes(further[:4], "big")
    return b"".join(parts)


def _row(payload: bytes) -> tuple[int, int, bytes] | None:
    """Read a row of `messages`: (id), topic, stamp, message; None where it is another table's."""
    end, place = _varint(payload, 0)
    kinds = []
    while place < end:
        kind, place = _varint(payload, place)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[1] not in _INTEGER_BYTES or kinds[2] not in _INTEGER_BYTES:
        return None
    if kinds[3] < 12 or kinds[3] % 2:
        return None
    numbers = []
    for kind in kinds[1:3]:
        width = _INTEGER_BYTES[kind]
        value = int.from_bytes(payload[place : place + width], "big", signed=True)
        numbers.append(value if width else kind - 8)
        place += width
    return numbers[0], numbers[1], payload[place : place + (kinds[3] - 12) // 2]


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """Read a number of one to nine bytes, the ninth of which counts whole, and the place behind it."""
    value = 0
    for byte in data[place : place + 8]:
        place += 1
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, place
    return value << 8 | data[place], place + 1
