"""Reads texts in blocks of whole lines, none of which is too long: memory holds one block."""

import io
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from fuselog.recorders.trajectories import NO_END

BLOCK_BYTES = 1 << 23
COMMENTS = (b"%", b"#")


def blocks_of(file: BinaryIO, doubts: set[str]) -> Iterator[bytes]:
    """Yield whole lines, as many as a block takes; raises ValueError where a line is longer.

    Of the last line, which may have no end, there is no block by itself; that is added to `doubts`.
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
    """Yield the lines one by one; raises ValueError where one is longer than a block."""
    while line := file.readline(BLOCK_BYTES + 1):
        if len(line) > BLOCK_BYTES:
            raise ValueError(f"it has a line of more than {BLOCK_BYTES >> 20} MB")
        yield line


class Chunks(io.RawIOBase):
    """Gives chunks of bytes, one after the other, as a file."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks, self._rest = chunks, b""

    def readable(self) -> bool:
        """Tell whether files can be read, as they are asked."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Fill the buffer as far as the chunk in hand goes; 0 at the end."""
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
    """Yield blocks with what is not UTF-8 replaced: Arrow's handler of rows takes no other bytes."""
    for block in blocks:
        yield block.decode("utf-8", "replace").encode()


def delimited(blocks: Iterator[bytes]) -> Iterator[bytes]:
    """Yield lines whose cells stand between white space, with commas; comments are passed over."""
    for block in blocks:
        yield b"".join(
            b",".join(line.split()) + b"\n"
            for line in block.splitlines()
            if not line.startswith(COMMENTS)
        )


def without(blocks: Iterator[bytes], heads: Sequence[bytes], left_out: Counter[str]) -> Iterator[bytes]:
    """Yield blocks without the lines that repeat the header; these are counted."""
    for block in blocks:
        if any(head in block for head in heads):
            lines = block.splitlines(keepends=True)
            kept = [line for line in lines if line.strip(b"\r\n") not in heads]
            if len(kept) < len(lines):
                left_out["that repeat the names of the columns"] += len(lines) - len(kept)
                block = b"".join(kept)
        yield block


def joined(opened: Callable[[Path], BinaryIO], paths: Sequence[Path]) -> Iterator[bytes]:
    """Yield the bytes of files one after the other, each ended by a newline; one is open at a time."""
    for path in paths:
        last = b"\n"
        with opened(path) as file:
            while chunk := file.read(BLOCK_BYTES):
                yield chunk
                last = chunk[-1:]
        if last != b"\n":
            yield b"\n"
