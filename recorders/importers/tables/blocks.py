"""Reads texts in blocks of whole lines, none of which is too long: memory holds one block."""

import io
from collections.abc import Iterator
from typing import BinaryIO

from recorders.trajectories import NO_END

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


class Utf8(io.RawIOBase):
    """Gives a text's blocks to Arrow, whose handler of rows takes no other bytes than UTF-8."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks, self._rest = blocks, b""

    def readable(self) -> bool:
        """Tell whether files can be read, as they are asked."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Fill the buffer as far as the block in hand goes; 0 at the end."""
        while not self._rest:
            block = next(self._blocks, None)
            if block is None:
                return 0
            self._rest = block.decode("utf-8", "replace").encode()
        size = min(len(buffer), len(self._rest))
        buffer[:size] = self._rest[:size]
        self._rest = self._rest[size:]
        return size


def delimited(blocks: Iterator[bytes]) -> Iterator[bytes]:
    """Yield lines whose cells stand between white space, with commas; comments are passed over."""
    for block in blocks:
        yield b"".join(
            b",".join(line.split()) + b"\n"
            for line in block.splitlines()
            if not line.startswith(COMMENTS)
        )
