"""Readers of texts in blocks of whole lines with a limited length, to limit memory."""

import io
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from fuselog.recorders.trajectories import NO_END

BLOCK_BYTES = 1 << 23
COMMENTS = (b"%", b"#")


def blocks_of(file: BinaryIO, doubts: set[str]) -> Iterator[bytes]:
    """Yield blocks of as many whole lines as fit; raise ValueError if a line is too long.

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
        """Return True, which makes this a readable file."""
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
    """Yield lines with commas in place of the white space between cells, without comments."""
    for block in blocks:
        yield b"".join(
            b",".join(line.split()) + b"\n"
            for line in block.splitlines()
            if not line.startswith(COMMENTS)
        )


def without(blocks: Iterator[bytes], heads: Sequence[bytes], left_out: Counter[str]) -> Iterator[bytes]:
    """Yield blocks without lines that repeat the header, which are counted."""
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
