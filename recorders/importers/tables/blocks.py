"""Readers of texts in blocks of whole lines; blocks have a limited length, to limit memory.

One kind of line is selected from receivers' logs whose lines begin with their kind.
"""

import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

from fuselog.recorders.errors import BadInput
from fuselog.recorders.trajectories import NO_END

BLOCK_BYTES = 1 << 23
COMMENTS = (b"%", b"#")

_HEADER_LINES = 1000
_NOVATEL = re.compile(rb"[#%][A-Z0-9]{3,}A,")
_NMEA = re.compile(rb"[$!](G[A-Z]|BD|QZ|AI|II|HE)[A-Z]{3},")
_INSPVA = (
    "week", "seconds_of_week", "latitude", "longitude", "height", "vel_n", "vel_e", "vel_u", "roll",
    "pitch", "heading", "status",
)  # fmt: skip
_NO_SOLUTION = re.compile(
    rb",(INS_INACTIVE|INS_ALIGNING|WAITING_|DETERMINING_ORIENTATION|MOTION_DETECT|INERTIAL_SOLUTION_NOT)"
)
_INSPVA_UNITS = {
    "seconds_of_week": "s", "latitude": "deg", "longitude": "deg", "height": "m", "vel_n": "m/s",
    "vel_e": "m/s", "vel_u": "m/s", "roll": "deg", "pitch": "deg", "heading": "deg",
}  # fmt: skip


def blocks_of(file: BinaryIO, doubts: set[str]) -> Iterator[bytes]:
    """Yield large blocks of whole lines; raise ValueError if a line is too long.

    The last line is never a block of its own. If it lacks a newline, `doubts` gets a note about it.
    """
    lines = rest = b""
    while block := file.read(BLOCK_BYTES):
        whole, newline, begun = (rest + block).rpartition(b"\n")
        rest = begun
        if newline:
            if lines:
                yield lines
            lines = whole + newline
        if len(rest) > BLOCK_BYTES:
            raise ValueError(f"it has a line of more than {BLOCK_BYTES >> 20} MB")
    if rest.strip():
        doubts.add(NO_END)
    if lines or rest:
        yield lines + rest


def lines_of(file: BinaryIO) -> Iterator[bytes]:
    """Yield the lines one by one; raise ValueError if one is longer than a block."""
    while line := file.readline(BLOCK_BYTES + 1):
        if len(line) > BLOCK_BYTES:
            raise ValueError(f"it has a line of more than {BLOCK_BYTES >> 20} MB")
        yield line


class Chunks(io.RawIOBase):
    """A file made from an iterator of chunks of bytes."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks, self._rest = chunks, b""

    def readable(self) -> bool:
        """Return True: this file can be read."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Fill the buffer from the current chunk; return the number of bytes, 0 at the end."""
        while not self._rest:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._rest = chunk
        size = min(len(buffer), len(self._rest))
        buffer[:size] = self._rest[:size]
        self._rest = self._rest[size:]
        return size


def utf8(blocks: Iterator[bytes]) -> Iterator[bytes]:
    """Replace invalid UTF-8 in blocks, since Arrow's handler of invalid rows accepts only UTF-8."""
    for block in blocks:
        yield block.decode("utf-8", "replace").encode()


def delimited(blocks: Iterator[bytes]) -> Iterator[bytes]:
    """Yield lines without comments, with commas in place of the white space between cells."""
    for block in blocks:
        yield b"".join(
            b",".join(line.split()) + b"\n"
            for line in block.splitlines()
            if not line.startswith(COMMENTS)
        )


def without(blocks: Iterator[bytes], heads: Sequence[bytes], left_out: Counter[str]) -> Iterator[bytes]:
    """Yield blocks without the lines that repeat the header; count these lines."""
    for block in blocks:
        if any(head in block for head in heads):
            lines = block.splitlines(keepends=True)
            kept = [line for line in lines if line.strip(b"\r\n") not in heads]
            if len(kept) < len(lines):
                left_out["that repeat the names of the columns"] += len(lines) - len(kept)
                block = b"".join(kept)
        yield block


def joined(opened: Callable[[Path], BinaryIO], paths: Sequence[Path]) -> Iterator[bytes]:
    """Yield the bytes of files in turn, each ended by a newline; one file is open at a time."""
    for path in paths:
        last = b"\n"
        with opened(path) as file:
            while chunk := file.read(BLOCK_BYTES):
                yield chunk
                last = chunk[-1:]
        if last != b"\n":
            yield b"\n"


class Tagged(NamedTuple):
    """Rows of one kind: the texts with which they begin, the marks around cells, the columns, the units.

    `invalid` matches rows that report no solution.
    """

    what: str
    begins: tuple[bytes, ...]
    after: bytes
    before: bytes
    columns: tuple[str, ...]
    units: dict[str, str]
    invalid: re.Pattern[bytes] | None = None

    def rows(self, blocks: Iterable[bytes], left_out: Counter[str]) -> Iterator[bytes]:
        """Yield the cells of this kind's rows, block by block; count other lines."""
        for block in blocks:
            lines = block.splitlines()
            own = [line for line in lines if line.startswith(self.begins)]
            valid = [line for line in own if not (self.invalid and self.invalid.search(line))]
            if len(own) < len(lines):
                left_out[f"that are not {self.what}"] += len(lines) - len(own)
            if len(valid) < len(own):
                left_out["without a solution"] += len(own) - len(valid)
            cells = (line.partition(self.after)[2].partition(self.before)[0] for line in valid)
            yield b"".join(each + b"\n" for each in cells)


def tagged_of(file: BinaryIO, path: Path) -> Tagged | None:
    """Recognise a receiver's log by its first lines; return the rows to read, or None for other files.

    Raises BadInput if the file is such a log, but has no rows that can be read.
    """
    lines = [line.rstrip() for line in islice(lines_of(file), 1)]
    first = lines[0] if lines else b""
    if _NMEA.match(first):
        raise BadInput(
            f"{path}: holds NMEA sentences, which are not a table; convert them first, for example with "
            "gpsbabel -i nmea -f FILE -o unicsv -F track.csv"
        )
    if _NOVATEL.match(first):
        begins = b"#INSPVAA,", b"%INSPVASA,"
        return Tagged("INSPVAA of NovAtel", begins, b";", b"*", _INSPVA, _INSPVA_UNITS, _NO_SOLUTION)
    if not first.startswith(b"$FLYS,"):
        return None
    said = {
        tuple(cells[:2]): cells[2:]
        for line in islice(lines_of(file), _HEADER_LINES)
        if len(cells := line.decode("utf-8", "replace").strip().split(",")) > 2
    }
    names, units = said.get(("$COL", "GNSS")), said.get(("$UNIT", "GNSS"), [])
    if names is None:
        raise BadInput(
            f"{path}: is a log of a FlySight without GNSS rows; give its TRACK.CSV, or a table with one "
            "kind of rows and their names above"
        )
    of_columns = {name: unit for name, unit in zip(names, units, strict=False) if unit}
    return Tagged("GNSS of a FlySight", (b"$GNSS,",), b",", b"\r", tuple(names), of_columns)
